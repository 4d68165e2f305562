"""The files that know FITS."""
