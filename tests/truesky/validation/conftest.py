"""The drawn sky of the catalogue's tests: where both run in one process it is drawn once."""

from tests.truesky.catalogue.conftest import drawn, dust, flat_sky, rng

__all__ = ["drawn", "dust", "flat_sky", "rng"]
