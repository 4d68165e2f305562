"""Emulator: observed catalogues without images, learned from catalogues measured on images."""
