"""Python interface: open a lake, run and check requests."""
