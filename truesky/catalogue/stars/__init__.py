"""Stars of the Milky Way, and Gaia's measurements of them."""
