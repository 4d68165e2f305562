"""Multipoles of mock galaxies in redshift space, and catalogues in which they cannot be measured."""

import numpy as np
import pytest

from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from tests.truesky.survey_maps import depths
from tests.truesky.validation.test_redshift_space import lognormal_points
from truesky.catalogue.halos import matching
from truesky.cosmology import FIDUCIAL
from truesky.survey_maps import random_points
from truesky.validation.lake.catalogues import redshift_multipoles
from truesky.validation.lake.catalogues.survey_mask import SurveyMask
from truesky.validation.verdicts import FAIL, NOT_APPLICABLE

CELLS = sky.cells_in_cone(0.0, 0.0, 3.0, GENERATION_ORDER)
PIXELS = depths.pixels_of(CELLS)
MASK = SurveyMask("euclid_vis", PIXELS[PIXELS % 13 > 0])
LOG_MASS = 12.5


def columns_of(place):
    """Columns of galaxies in redshift space, in halos of one mass, from positions with x along the line of sight."""
    chi = np.sqrt(np.sum(place**2, 1))
    ra, dec = np.degrees(np.arctan2(place[:, 1], place[:, 0])) % 360.0, np.degrees(np.arcsin(place[:, 2] / chi))
    n = len(chi)
    return {
        "id": np.arange(n), "ra": ra, "dec": dec, "_healpix_29": sky.healpix_29(ra, dec), "kind": np.zeros(n, np.int8),
        "z_obs": np.asarray(FIDUCIAL.redshift(chi)), "mag_r01": np.full(n, 20.0), "log_halo_mass": np.full(n, LOG_MASS),
    }  # fmt: skip


@pytest.fixture(scope="module")
def random_columns():
    points = random_points.draw_points(CELLS.tolist(), 2.0, 1, depths.depth_map(PIXELS))
    return {name: points[name] for name in redshift_multipoles.RANDOM_COLUMNS}


def in_box(rng, n):
    return rng.uniform(0.0, 1.0, (n, 3)) * np.array([1100.0, 260.0, 260.0]) + np.array([950.0, -130.0, -130.0])


def by_name(result):
    return {row.quantity: row for row in result.rows}


def test_galaxies_that_fall_towards_each_other(random_columns):
    """Sample: one volume of 28 deg2 at 0.4 < z < 0.8; significance 6e-7 for each (5 jackknife errors)."""
    halos = matching.masses(FIDUCIAL)
    bias = float(halos.interpolate_pairs(halos.bias, np.array([0.6]), np.array([LOG_MASS]))[0])
    place, _ = lognormal_points(4, (220, 52, 52), 5.0, 80_000, bias)
    result = redshift_multipoles.compare(
        columns_of(place + np.array([950.0, -130.0, -130.0])), random_columns, MASK, FIDUCIAL
    )
    rows = by_name(result)
    assert set(rows) == {"xi_0", "xi_2", "ratio"}
    for row in rows.values():
        assert abs(row.value - 1.0) < 5.0 * row.error
    assert max(rows["xi_0"].error, rows["xi_2"].error) < 0.5
    assert result.series["multipoles"].shape == (7, 4)


def test_galaxies_that_do_not_cluster_fail(random_columns):
    columns = columns_of(in_box(np.random.default_rng(3), 60_000))
    assert by_name(redshift_multipoles.compare(columns, random_columns, MASK, FIDUCIAL))["xi_0"].verdict == FAIL


def test_what_cannot_be_measured_has_a_reason(random_columns):
    columns = columns_of(in_box(np.random.default_rng(5), 60_000))
    few = {name: values[:100] for name, values in columns.items()}
    small = SurveyMask("euclid_vis", depths.pixels_of(CELLS[:120]))
    unknown = columns | {"log_halo_mass": np.full(60_000, np.nan)}
    for chosen, mask, words in (
        (few, MASK, "2000 of both are required"),
        (columns, small, "too small for pairs 40 Mpc/h, or 2.1 deg, apart"),
        (unknown, MASK, "the masses of the halos"),
    ):
        (row,) = redshift_multipoles.compare(chosen, random_columns, mask, FIDUCIAL).rows
        assert row.verdict == NOT_APPLICABLE
        assert words in row.note
