"""Catalogues in the forms of others."""
