"""Conversion between the sky and the tangent plane about a boresight."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from lake_schema import sky
from truesky.render.camera import pointing

ANGLES = st.floats(0.0, 360.0)
PLACES = st.lists(st.tuples(st.floats(-5e4, 5e4), st.floats(-5e4, 5e4)), min_size=1, max_size=5)


@given(ANGLES, st.floats(-90.0, 90.0), ANGLES, PLACES)
def test_plane_of_sky_is_the_inverse_of_sky_of_plane(ra, dec, angle, places):
    """Positions up to 14 deg from the boresight agree within a microarcsecond."""
    x, y = np.array(places).T
    directions = sky.unit_vectors(*pointing.sky_of_plane(x, y, ra, dec, angle))
    to_x, to_y, is_near = pointing.plane_of_sky(directions, ra, dec, angle)
    assert is_near.all()
    np.testing.assert_allclose(to_x, x, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(to_y, y, rtol=0.0, atol=1e-6)


def test_directions_behind_the_telescope_are_not_near():
    *_, is_near = pointing.plane_of_sky(sky.unit_vectors([10.0, 190.0, 75.0], [0.0, 0.0, 0.0]), 10.0, 0.0, 0.0)
    assert is_near.tolist() == [True, False, False]
