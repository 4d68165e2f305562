"""Diffuse light of the sky, and visibility of fields."""
