"""Prepare the sources of light on a detector: read catalogue rows, and compute shapes, colours and pictures."""
