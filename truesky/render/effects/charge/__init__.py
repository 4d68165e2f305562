"""Detector effects that add, move or remove charge in the pixels."""
