"""Draw windows: rectangles of pixels, without the rest of the detector."""
