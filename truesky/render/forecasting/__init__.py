"""Forecast the cost of a user's request before it runs (table rows, CPU seconds, bytes), and compare it afterwards."""
