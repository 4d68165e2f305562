"""Checks of catalogues, a file each: what a lake's galaxies are, beside what is observed, required and foreseen."""
