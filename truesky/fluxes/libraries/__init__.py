"""Read and compute libraries of template spectra."""
