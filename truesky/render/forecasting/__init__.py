"""Forecast the cost of a request before it runs: rows, seconds, bytes, and the speed of this machine."""
