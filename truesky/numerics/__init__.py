"""Arithmetic that gives the same bits on every machine, compiled functions, and the cache of computed arrays."""
