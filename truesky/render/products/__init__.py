"""Write the image of a rendered detector to FITS files, read it back, and draw pictures of it."""
