"""Declarations of the tables of sources that vary."""
