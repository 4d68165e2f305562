"""Added sources belong to the universe of the lake."""

from dataclasses import replace

import pytest

from truesky.catalogue import added_sources
from truesky.cosmology import FIDUCIAL

TABLE = {"ra": [10.0], "dec": [0.0], "mag": [22.0], "z_true": [0.8], "half_light_radius": [0.5], "axis_ratio": [0.7]}


def test_absolute_magnitudes_follow_the_cosmology():
    other = replace(FIDUCIAL, omega_m=0.25)
    drawn = [
        added_sources.rows({"galaxies": TABLE}, "euclid_vis", ["euclid_vis"], cosmology)[0]
        for cosmology in (FIDUCIAL, other)
    ]
    change = float(other.distance_modulus(0.8) - FIDUCIAL.distance_modulus(0.8))
    assert change > 0.05
    found, light = (
        [float(tables[number][column].to_numpy()[0]) for tables in drawn]
        for number, column in enumerate(("abs_mag_r01", "f_nu_euclid_vis"))
    )
    assert found[0] - found[1] == pytest.approx(change, abs=2e-5)
    # The light is that of the given magnitude.
    assert light[0] == pytest.approx(light[1], rel=1e-5)
