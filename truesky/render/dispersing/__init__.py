"""Draw slitless spectra: the light of every source on a detector, dispersed by a grism."""
