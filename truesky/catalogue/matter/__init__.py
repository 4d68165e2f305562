"""Simulate the large-scale matter: linear theory, a periodic box, its light-cone and the lensing convergence."""
