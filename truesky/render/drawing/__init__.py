"""Draw the expected light of stars and galaxies onto the image of a detector, with the PSF."""
