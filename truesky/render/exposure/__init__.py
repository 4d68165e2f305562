"""One detector of one exposure, from catalogue rows to raw image."""
