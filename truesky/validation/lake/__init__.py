"""Measure what a lake contains and compare it with what its request and the mission database imply."""
