"""Draw a universe and compare its statistics with published observations and with theory."""
