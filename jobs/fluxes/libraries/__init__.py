"""Spectral libraries."""
