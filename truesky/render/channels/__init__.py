"""Channels: their effects in order, PSF, readout, sky and measured costs."""
