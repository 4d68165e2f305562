"""Reading and writing of FITS files."""
