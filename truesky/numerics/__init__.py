"""Arithmetic with the same bits on every machine, compiled functions, and a disc cache of computed arrays."""
