"""Detectors, pointing, astrometry and lamps."""
