"""Diffuse light of the sky."""
