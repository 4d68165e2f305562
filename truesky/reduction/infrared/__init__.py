"""Calibrate frames of the infrared detectors of NISP: ramps, nonlinearity, lamps of flats, and persistence."""
