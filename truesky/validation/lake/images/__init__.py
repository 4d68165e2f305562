"""Checks of simulated images: measured numbers are compared with the headers and the catalogues; one file per check."""
