"""Share the drawn sky with the tests of the catalogue, so that one process draws it once."""

from tests.truesky.catalogue.conftest import drawn, dust, flat_sky, rng

__all__ = ["drawn", "dust", "flat_sky", "rng"]
