"""Geometry of cameras: detectors, amplifiers, pointing, astrometry, filter and grism wheels, and calibration lamps."""
