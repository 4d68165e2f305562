"""Checks of the catalogues of a lake against observations, requirements and theory; one file per check."""
