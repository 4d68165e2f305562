"""Validation: figures of the simulated sky compared with expectations from theory and from observations."""
