"""Reduce raw frames to calibrated images and stacks, as the pipeline of an observatory does."""
