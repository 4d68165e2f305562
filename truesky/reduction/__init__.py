"""From raw frames to calibrated images, and from these to a stack: what an observatory's pipeline does."""
