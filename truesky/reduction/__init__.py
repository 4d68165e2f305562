"""Reduce simulated raw frames to calibrated images, catalogues and stacks, as the pipeline of an observatory does."""
