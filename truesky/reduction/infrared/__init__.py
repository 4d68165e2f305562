"""Reduce NISP frames: ramps, linearity, lamps, persistence."""
