"""Inner loops for drawing stars and galaxies, compiled by numba."""
