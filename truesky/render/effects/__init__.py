"""Effects of a detector and its electronics on the pixels of an image: on light, on charge, and during readout."""
