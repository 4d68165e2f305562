"""Random points are uniform in the covered area, and do not depend on the area, the density, the band or the files."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2, kstest

from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from lake_schema.tables.survey.depth import ORDER
from lake_schema.tables.survey.randoms import RANDOMS
from scripts import two_point_references
from tests.truesky.survey_maps import depths
from truesky.randomness.rng import stream
from truesky.survey_maps import random_points
from truesky.validation import pairs, two_points

CELLS = [400_000, 400_001, 400_003]
DENSITY = 30.0


def points(cells=CELLS, density=DENSITY, seed=1, **values):
    pixels = depths.pixels_of(cells)
    return random_points.draw_points(cells, density, seed, depths.depth_map(pixels, **values))


@pytest.fixture(scope="module")
def scattered():
    return points()


def reference(cells, density, seed, depth):
    """Draw and keep the points of each cell one after the other, and look up each in the depth map by its position."""
    kept = []
    for cell in cells:
        arrivals, at = [], 0.0
        steps = stream(seed, "randoms.number", cell)
        while (at := at + steps.standard_exponential()) < density * 3600.0 * sky.cell_area(GENERATION_ORDER):
            arrivals.append(at)
        position, coverage = (stream(seed, f"randoms.{name}", cell) for name in ("position", "coverage"))
        for number in range(len(arrivals)):
            index = (cell << 42) + int(position.integers(0, 1 << 42))
            ra, dec = sky.positions_of_indices([index])
            (row,), chance = depth.rows_at(ra, dec), coverage.random()
            if row >= 0 and chance < depth.columns["covered"][row]:
                kept.append((index, (6 << 60) + (cell << 40) + number, ra[0], dec[0], row))
    return sorted(kept)


def test_points_are_those_of_the_slow_reference():
    pixels = depths.pixels_of(CELLS[:2])
    covered = np.linspace(0.0, 1.0, len(pixels), dtype=np.float32)[pixels % 3 > 0]
    pixels = pixels[pixels % 3 > 0]
    depth = depths.depth_map(pixels, covered=covered, depth_point=np.arange(len(pixels), dtype=np.float32))
    found = random_points.draw_points(CELLS[:2], 3.0, 7, depth)
    index, identifier, ra, dec, row = map(np.array, zip(*reference(CELLS[:2], 3.0, 7, depth), strict=True))
    assert len(index) > 200
    for name, wanted in (("_healpix_29", index), ("id", identifier), ("ra", ra), ("dec", dec), ("depth_point", row)):
        np.testing.assert_array_equal(found[name], wanted)


def test_points_have_the_density_that_was_asked_for(scattered):
    """Sample: 17,000 points in three cells; significance 6e-7 (5 standard errors)."""
    wanted = len(CELLS) * sky.cell_area(GENERATION_ORDER) * 3600.0 * DENSITY
    assert abs(len(scattered["id"]) - wanted) < 5.0 * np.sqrt(wanted)


def test_points_are_uniform(scattered):
    """Sample: 17,000 points, in 192 equal areas and inside their smallest cells; significance 1e-4 for each."""
    cell = scattered["_healpix_29"] >> 2 * (sky.MAX_ORDER - GENERATION_ORDER - 3)
    count = np.unique(cell, return_counts=True)[1]
    assert len(count) == 3 * 64
    assert chi2.sf(np.sum((count - count.mean()) ** 2) / count.mean(), 191) > 1e-4
    low = scattered["_healpix_29"] & ((1 << 2 * (sky.MAX_ORDER - ORDER)) - 1)
    assert kstest(low / 2.0 ** (2 * (sky.MAX_ORDER - ORDER)), "uniform").pvalue > 1e-4


def test_numbers_of_points_are_poisson_numbers():
    """Sample: 2000 cells with a mean of 5; significance 1e-4 of the variance over the mean (3.9 standard errors)."""
    number = np.array([random_points._poisson_number(cell, 5.0, 3) for cell in range(2000)])
    assert abs(number.mean() - 5.0) < 3.9 * np.sqrt(5.0 / 2000)
    assert abs(number.var() / number.mean() - 1.0) < 3.9 * np.sqrt(2.0 / 2000)


@given(low=st.floats(0.0, 300.0), high=st.floats(0.0, 300.0), cell=st.integers(0, 786_431))
@settings(max_examples=50, deadline=None)
def test_more_points_never_become_fewer(low, high, cell):
    first, second = (random_points._poisson_number(cell, mean, 1) for mean in sorted((low, high)))
    assert first <= second


@pytest.mark.parametrize("density", [1e-3, 0.5, 29.9])
def test_a_higher_density_keeps_the_points_of_a_lower_one(scattered, density):
    few = points(density=density)
    at = np.searchsorted(scattered["_healpix_29"], few["_healpix_29"])
    for name, values in few.items():
        np.testing.assert_array_equal(scattered[name][at], values)


@pytest.mark.parametrize("cells", [CELLS[:1], CELLS[1:], [*CELLS, 400_010]])
def test_points_do_not_depend_on_the_area(scattered, cells):
    other = points(cells)
    common = np.isin(scattered["_healpix_29"] >> 42, cells)
    mutual = np.isin(other["_healpix_29"] >> 42, CELLS)
    for name, values in other.items():
        np.testing.assert_array_equal(scattered[name][common], values[mutual])


def test_other_seeds_give_other_points(scattered):
    assert not np.isin(points(seed=2)["_healpix_29"], scattered["_healpix_29"]).any()


def test_points_are_kept_with_the_covered_fraction_of_their_pixel(scattered):
    """Sample: 17,000 points in pixels of three fractions; significance 6e-7 for each (5 standard errors)."""
    pixels = depths.pixels_of(CELLS)
    share = np.array([0.0, 0.3, 1.0], np.float32)[pixels % 3]
    found = points(covered=share)
    assert np.isin(found["id"], scattered["id"]).all()
    for residue, fraction in enumerate((0.0, 0.3, 1.0)):
        number, total = (
            np.count_nonzero((columns["_healpix_29"] >> 30) % 3 == residue) for columns in (found, scattered)
        )
        assert abs(number - fraction * total) <= 5.0 * np.sqrt(total * fraction * (1.0 - fraction))


def test_points_have_the_values_of_their_pixel():
    pixels = depths.pixels_of(CELLS)
    depth = depths.depth_map(
        pixels, mask=(pixels % 128).astype(np.int16), depth_point=(20.0 + pixels % 7).astype(np.float32)
    )
    found = random_points.draw_points(CELLS, DENSITY, 1, depth)
    row = depth.rows_at(found["ra"], found["dec"])
    assert (row >= 0).all()
    for name in random_points.DEPTH_COLUMNS:
        np.testing.assert_array_equal(found[name], depth.columns[name][row])


def test_identifiers_are_unique_and_rows_follow_the_declaration(scattered):
    assert len(np.unique(scattered["id"])) == len(scattered["id"])
    assert np.all(np.diff(scattered["_healpix_29"]) >= 0)
    np.testing.assert_array_equal(sky.healpix_29(scattered["ra"], scattered["dec"]), scattered["_healpix_29"])
    rows = RANDOMS.build({**scattered, "band": np.full(len(scattered["id"]), "euclid_vis", object)})
    assert rows["detection"].null_count == rows.num_rows


def test_a_model_of_the_detection_fills_its_column():
    pixels = depths.pixels_of(CELLS)
    depth = depths.depth_map(pixels, depth_point=(24.0 + pixels % 3).astype(np.float32))
    found = random_points.draw_points(CELLS, DENSITY, 1, depth, lambda limit: (limit - 24.0) / 2.0)
    np.testing.assert_array_equal(found["detection"], (found["depth_point"] - 24.0) / 2.0)


def test_an_area_without_depth_has_no_points():
    empty = depths.depth_map(np.zeros(0, np.int64))
    found = random_points.draw_points(CELLS, DENSITY, 1, empty)
    assert {len(values) for values in found.values()} == {0}


def test_uniform_points_with_holes_do_not_cluster():
    """Sample: 2,300 points and 14,000 random points, 8 bins of w; significance 6e-5 for each (4 errors of TreeCorr)."""
    sets = two_point_references.points_with_holes()
    place = np.concatenate([sky.unit_vectors(one["ra"], one["dec"]) for one in sets])
    number = np.array([len(one["id"]) for one in sets])
    kind = np.repeat([0, 1], number)
    counts = pairs.count_pairs(place, kind, np.zeros(len(kind), int), np.radians(two_point_references.THETA / 60.0))
    w, error = two_points.landy_szalay(counts.total, number.astype(float)), two_point_references.read_values("w_error")
    np.testing.assert_allclose(w, two_point_references.read_values("w"), atol=1e-3)
    assert np.all(np.abs(w) < 4.0 * error)
    assert error.max() < 0.03
