"""Validation: numbers measured in the simulated sky are compared with expectations from theory and observations."""
