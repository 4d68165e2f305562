"""Write the catalogues of galaxies and stars in formats of other programs (SCAMP, skyCatalogs)."""
