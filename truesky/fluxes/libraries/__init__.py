"""Read and compute libraries of template spectra of galaxies and stars."""
