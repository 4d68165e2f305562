"""Measure the contents of a lake and compare them with what its request and the mission database imply."""
