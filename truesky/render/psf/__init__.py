"""Models of the point-spread functions (PSFs) of all cameras, in space and on the ground."""
