"""Haloes and the galaxies in them."""
