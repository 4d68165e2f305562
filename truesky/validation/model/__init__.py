"""Simulate galaxies, halos and stars, measure their statistics, and compare these with observations and theory."""
