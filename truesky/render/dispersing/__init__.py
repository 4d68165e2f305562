"""Spectra without a slit: every source's light, spread out by a grism."""
