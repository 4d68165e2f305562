"""Detector effects that add, move or remove charge in the pixels, such as dark current, cosmic rays and bleeding."""
