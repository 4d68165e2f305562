"""Draw the active nuclei of galaxies, and the halos of quasars."""
