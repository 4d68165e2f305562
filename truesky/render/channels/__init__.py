"""Channels (instrument modes): VIS, NISP-P (filters), NISP-S (grisms) and ground cameras.

Each defines its detector effects in order, its PSF, readout, sky and measured costs.
"""
