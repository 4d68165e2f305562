"""Simulate the image of one detector in one exposure, from catalogue rows to the raw image."""
