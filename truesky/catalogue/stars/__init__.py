"""The Milky Way's stars."""
