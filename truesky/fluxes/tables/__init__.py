"""Compute band fluxes of galaxies and stars by interpolation in precomputed tables."""
