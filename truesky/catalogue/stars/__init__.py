"""Draw the stars of the Milky Way, and simulated Gaia measurements of these stars."""
