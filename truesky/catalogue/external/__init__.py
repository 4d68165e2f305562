"""Readers of the user's catalogues."""
