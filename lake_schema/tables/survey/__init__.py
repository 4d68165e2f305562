"""Declarations of the tables of a survey's maps, its random points and its observed sources."""
