"""What differs from channel to channel: effects and their order, PSF, readout, sky, measured costs."""
