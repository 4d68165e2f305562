"""Light of the sky that no source gives."""
