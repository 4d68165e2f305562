"""Reading and writing of FITS files: images, binary tables, LDAC catalogues and PSFEx models."""
