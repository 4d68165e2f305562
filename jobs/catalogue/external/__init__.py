"""Catalogues of others."""
