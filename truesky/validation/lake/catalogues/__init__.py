"""Checks of the galaxy and star catalogues of a lake: observations, mission requirements and theory; one file each."""
