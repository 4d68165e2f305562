"""Halos and the galaxies in them."""
