"""Checks of images against their headers and the tables of the lake; one file per check."""
