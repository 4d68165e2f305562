"""Draw dark matter halos, and the galaxies in them with their luminosities."""
