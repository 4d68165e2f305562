"""Supernovae follow the light of their hosts."""

import numpy as np
import pytest

from tests.truesky.catalogue.transients.hosts import galaxies
from truesky.catalogue.transients import places

N = 40_000


def offsets(in_disc=False, **changes):
    plain = {"kappa": np.zeros(N), "gamma1": np.zeros(N), "gamma2": np.zeros(N), "position_angle": np.zeros(N)}
    hosts = galaxies(N, **{name: np.broadcast_to(value, N) for name, value in {**plain, **changes}.items()})
    return places.draw_offsets(hosts, np.full(N, in_disc), np.random.default_rng(4))


@pytest.mark.parametrize("index", [0.5, 1.0, 2.5, 4.0])
def test_half_are_inside_the_half_light_radius(index):
    """Sample: 40,000 supernovae; the fraction has an error of 0.0025, and the constant b one of 1e-3: 4 sigma."""
    changes = {"bulge_sersic_index": index, "bulge_half_light_radius": 0.6, "bulge_axis_ratio": 1.0}
    radius = np.hypot(*offsets(bulge_fraction=1.0, **changes))
    assert np.mean(radius < 0.6) == pytest.approx(0.5, abs=0.01)
    assert radius.max() <= 5.0 * 0.6 * (1 + 1e-12)


def test_the_major_axis_points_to_the_position_angle():
    """Sample: 40,000 supernovae in a thin disc at 30 deg east of north; the angle has an error of 0.2 deg: 3 sigma."""
    east, north = offsets(bulge_fraction=0.0, disk_axis_ratio=0.2, position_angle=30.0)
    angle = 0.5 * np.degrees(np.arctan2(2.0 * np.mean(east * north), np.mean(north**2 - east**2)))
    assert angle == pytest.approx(30.0, abs=0.6)


def test_lensing_stretches_offsets():
    """With the same random numbers, offsets are those without lensing times the inverse of 1 - kappa - shear."""
    plain, lensed = offsets(bulge_fraction=0.0), offsets(bulge_fraction=0.0, kappa=0.1, gamma1=0.05, gamma2=-0.02)
    matrix = np.linalg.inv(np.array([[0.9 - 0.05, 0.02], [0.02, 0.9 + 0.05]]))
    np.testing.assert_allclose(np.array(lensed), matrix @ np.array(plain), rtol=1e-12, atol=1e-12)


def test_young_stars_are_in_the_disc():
    """Sample: 40,000 supernovae in galaxies with a bulge 100 times smaller than the disc."""
    sizes = {"bulge_half_light_radius": 0.01, "disk_half_light_radius": 1.0, "disk_axis_ratio": 1.0}
    old, young = (np.hypot(*offsets(in_disc, bulge_fraction=0.5, **sizes)) for in_disc in (False, True))
    assert np.mean(old < 0.1) == pytest.approx(0.5, abs=0.03)
    assert np.mean(young < 0.1) < 0.03
    without_disc = np.hypot(*offsets(in_disc=True, bulge_fraction=1.0, **sizes))
    assert without_disc.max() < 0.1
