"""Effects of a detector and its electronics on light and charge, one effect per file."""
