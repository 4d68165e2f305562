"""Exports of the catalogues in formats of other programs."""
