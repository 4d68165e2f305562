"""External catalogues."""
