"""Compute band fluxes from precomputed tables."""
