"""Compiled inner loops of drawing."""
