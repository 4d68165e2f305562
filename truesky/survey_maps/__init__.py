"""Maps of a survey: depth and masks on the sky, and random points in the area that they cover."""
