"""Point-spread functions of all cameras."""
