"""Which exposures of the sky can be combined to a master of fringes."""

from types import SimpleNamespace

import numpy as np
import pytest

from truesky.reduction import fringe_masters


@pytest.mark.parametrize(
    ("steps", "is_enough"),
    # Distances from the first pointing, arcsec to the east.
    [((), False), ((0, 60), False), ((0, 60, 120), True), ((0, 60, 120, 120), False), ((0, 0, 60, 60), False),
     ((0, 0, 60, 60, 120, 120), True), ((0, 2, 60), False)],
)  # fmt: skip
@pytest.mark.parametrize(("ra", "dec"), [(0.0, 0.0), (359.99, 60.0), (10.0, -89.9)])
def test_fewer_than_half_of_the_exposures_may_have_the_same_pointing(steps, is_enough, ra, dec):
    """Otherwise the median contains the sources that lie at the same pixels in half of them."""
    places = [(ra + step / 3600.0 / np.cos(np.radians(dec))) % 360.0 for step in steps]
    frames = [SimpleNamespace(exposure=SimpleNamespace(ra=place, dec=dec)) for place in places]
    assert fringe_masters.can_combine(frames) is is_enough
