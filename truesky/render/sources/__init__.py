"""Which catalogue rows shine, and how they look."""
