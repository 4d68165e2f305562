"""Draw supernovae in the galaxies of a lake."""
