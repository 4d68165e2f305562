"""Add sources to calibrated frames of real telescopes, which are given as FITS images."""
