"""The compiled loops of drawing."""
