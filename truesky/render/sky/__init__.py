"""Diffuse light of the sky (zodiacal light, night sky, thermal light), and the dates at which fields are visible."""
