"""Band fluxes from precomputed tables."""
