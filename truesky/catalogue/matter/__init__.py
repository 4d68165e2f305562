"""Linear theory, the box of matter, its light-cone and the convergence."""
