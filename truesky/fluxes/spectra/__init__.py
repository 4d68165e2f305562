"""Compute the components of spectra: mixtures of templates, dust, emission lines and intergalactic absorption."""
