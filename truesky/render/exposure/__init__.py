"""Render one detector of one exposure, from catalogue rows to the raw image."""
