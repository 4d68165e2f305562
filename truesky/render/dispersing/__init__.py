"""Slitless spectra: the light of every source, dispersed by a grism."""
