"""What a detector and its electronics do to light, one effect a file."""
