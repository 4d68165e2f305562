"""Magnitude limits in other bands become limits in I_E with as many galaxies."""

import numpy as np
import pytest

from lake_schema.mission.configuration import resolve
from truesky.render.planning import source_counts
from truesky.request.schema import Universe


def test_a_limit_in_the_band_of_the_counts_stays():
    assert source_counts.euclid_limit(Universe(galaxy_limit=23.7)) == pytest.approx(23.7, abs=0.01)


@pytest.mark.parametrize(
    ("band", "limit", "expected"),
    # A catalogue of 0.47 deg2 to I_E = 26.3 has as many galaxies with I_E < 24 as with these limits.
    [("lsst_g", 24.64, 24.0), ("lsst_i", 23.93, 24.0), ("lsst_y", 23.43, 24.0), ("euclid_h", 22.50, 24.0)],
)
def test_limits_have_as_many_galaxies_in_other_bands(band, limit, expected):
    universe = Universe(galaxy_limit=limit, galaxy_band=band)
    assert source_counts.euclid_limit(universe) == pytest.approx(expected, abs=0.05)


def test_the_limit_of_a_band_that_is_not_built_in_is_used_as_it_is():
    assert source_counts.euclid_limit(Universe(galaxy_limit=21.5, galaxy_band="my_band")) == 21.5


def test_densities_count_galaxies_in_the_band_of_the_limit():
    mission, place = resolve(), (np.array([53.0]), np.array([-28.0]))
    in_h, in_i = (
        source_counts.Densities(mission, Universe(galaxy_limit=24.0, galaxy_band=band)).at(*place)[0, 0]
        for band in ("euclid_h", "euclid_vis")
    )
    assert 2.0 < in_h / in_i < 3.0
