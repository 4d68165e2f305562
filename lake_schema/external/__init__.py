"""External files and tables."""
