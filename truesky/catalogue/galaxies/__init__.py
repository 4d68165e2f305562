"""Draw the properties of galaxies: colours, spectra, masses, emission lines, shapes and lensing."""
