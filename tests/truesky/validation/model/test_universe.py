"""The simulated universe against its expectations: a few cells in each run, everything at night.

A few cells contain few structures, so tolerances are the values of the list plus two errors of the blocks.
"""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from tests.truesky.catalogue.galaxies.test_lensing import limber
from truesky.catalogue.halos import luminosity_function
from truesky.cosmology import FIDUCIAL
from truesky.validation import __main__, checks
from truesky.validation.model import census, clustering, shear
from truesky.validation.model import universe as measured


@pytest.fixture(scope="module")
def seen(drawn):
    """Return the drawn sky as the validation measures it."""
    first = np.array(drawn.places[::4]) // 4
    deepest = 2 * (sky.MAX_ORDER - GENERATION_ORDER) + 2

    def block(index):
        return np.searchsorted(first, index >> deepest)

    halos = {name: drawn.halos[name].to_numpy() for name in census.HALO_COLUMNS}
    return census.Census(
        blocks=first.size,
        area=drawn.area,
        limit=26.0,
        rows=drawn.columns,
        block=block(drawn.columns["_healpix_29"]),
        mags=drawn.mags,
        halos=halos,
        halo_block=block(drawn.halos["_healpix_29"].to_numpy()),
    )


def failed(figures):
    return [(check.name, check.value) for check in checks.evaluate(figures, 2.0) if not check.passes]


def test_colours(seen):
    assert failed(census.colours(seen)) == []


def test_sizes(seen):
    assert failed(census.sizes(seen)) == []


def test_sizes_by_mass(seen):
    figures = census.sizes_by_mass(seen, FIDUCIAL)
    assert len(figures) == 10
    assert failed(figures) == []


def test_galaxies_without_compact_ones_are_too_large(seen):
    """Remove the smaller half at z > 1.5: no galaxy of 10^10.75 Msun is as small as an early type."""
    rows = dict(seen.rows)
    small = (rows["bulge_half_light_radius"] < 0.2) & (rows["z_true"] > 1.5)
    rows = {name: values[~small] for name, values in rows.items()}
    off = {name for name, _ in failed(census.sizes_by_mass(replace(seen, rows=rows), FIDUCIAL))}
    assert {"log_size_p16_z1.75", "log_size_p16_z2.25", "log_size_p16_z2.75"} <= off


def test_ellipticities(seen):
    figures = census.ellipticities(seen)
    assert len(figures) == 3
    assert failed(figures) == []


def test_flat_bulges_are_noticed(seen):
    """A normal distribution of mean 0.75 and scatter 0.15, as flat as discs are thick."""
    ratio = np.clip(np.random.default_rng(1).normal(0.75, 0.15, seen.block.size), 0.3, 1.0)
    assert len(failed(census.ellipticities(replace(seen, rows={**seen.rows, "bulge_axis_ratio": ratio})))) == 3


def test_halpha(seen):
    assert failed(census.halpha(seen)) == []


def test_halos(seen):
    assert failed(census.halos(seen, measured.mass_function(FIDUCIAL))) == []


def test_luminosities(seen):
    figures = census.luminosities(seen, luminosity_function.schechter(), 0.0, 1.5)
    assert len(figures) == 6
    assert failed(figures) == []


def test_a_figure_that_is_off_fails():
    good = {"sigma_8": 0.833, "half_light_worst": 0.009, "log_i_21.75": 4.0}
    bad = {"sigma_8": 0.81, "log_i_21.75": 3.9}
    assert failed({**good, "log_i_21.75_error": 0.0}) == []
    assert [name for name, _ in failed({**bad, "log_i_21.75_error": 0.03})] == ["sigma_8", "log_i_21.75"]
    # The error of the fraction of emitters equals the error of their number.
    counted = {"halpha_2e-16_0.9_1.8": 1.07, "halpha_2e-16_0.9_1.8_error": 0.03}
    (check,) = checks.evaluate(counted)
    assert check.passes
    assert check.upper_limit == pytest.approx(1.08)


@pytest.fixture
def coarse(monkeypatch):
    """Use pixels of 27 arcmin in blocks of 54 deg2."""
    monkeypatch.setattr(clustering, "DEPTH", 4)


def points(ra, dec):
    none = np.zeros(ra.size)
    return clustering.Tracers(ra, dec, none, none, none > 0, none, none, none)


def test_uniform_points_are_not_correlated(coarse, rng):
    edges, order, blocks = np.array([0.6, 1.0, 2.0]), clustering.BLOCK_ORDER, []
    for cell in (3, 100, 500, 767):
        _, ra, dec = sky.random_in_cell(order, cell, 40_000, rng)
        blocks.append((cell, (points(ra, dec),)))
    (found,) = clustering.correlation(blocks, order, edges)
    assert np.all((found.theta > edges[:-1]) & (found.theta < edges[1:]))
    assert np.abs(found.w).max() < 2e-3
    pairs = found.pairs
    assert 3.0 < pairs.nodes @ pairs.of_all < 5.0
    assert pairs.of_bin @ pairs.nodes == pytest.approx(found.theta, rel=0.03)


def test_effect_of_the_block_mean(coarse):
    """Compare with the covariance of all pixels relative to their mean."""
    edges, order, cell = np.array([0.6, 1.0, 2.0]), clustering.BLOCK_ORDER, 100
    pairs = clustering._pixel_pairs(order, cell, edges)
    place = clustering._vectors(order, cell)
    theta = np.degrees(np.arccos(np.clip(place @ place.T, -1.0, 1.0)))
    many = len(place)
    less = np.eye(many) - 1.0 / many
    left = less @ np.exp(-theta) @ less
    found, wanted = pairs.subtract_block_mean(np.exp(-pairs.nodes)), []
    for first, last in pairwise(edges):
        inside = (theta > first) & (theta < last)
        wanted.append((np.exp(-theta[inside]).mean(), left[inside].mean()))
    assert np.transpose(found) == pytest.approx(np.array(wanted), rel=0.02)
    # A pixel with neighbours at a separation lies further inside than most, so the mean of pairs subtracts too little.
    assert np.all(found[1] < found[0] - pairs.of_all @ np.exp(-pairs.nodes))


def test_points_of_a_dense_half_are_correlated(coarse, rng):
    """The halves of a block differ in density by a factor of 3: delta is +-1/2, and 16 of 480 neighbours lie across."""
    edges, order, blocks = np.array([0.4, 0.6]), clustering.BLOCK_ORDER, []
    for cell in (3, 100, 500, 767):
        _, ra, dec = sky.random_in_cell(order, cell, 60_000, rng)
        dense = sky.cell_at(ra, dec, order + 1) % 4 < 2
        kept = dense | (rng.random(ra.size) < 1 / 3)
        blocks.append((cell, (points(ra[kept], dec[kept]),)))
    (found,) = clustering.correlation(blocks, order, edges)
    assert found.w[0] == pytest.approx(0.25 * (1 - 2 * 16 / 480), abs=0.02)


def test_theory_agrees_with_lensing_sums():
    """C_l agrees with the sums of the lensing tests, and the ratio of theory to itself is 1."""
    ell = np.array([50.0, 200.0, 400.0])
    chi = float(FIDUCIAL.comoving_distance(1.0))
    assert shear.linear_theory(FIDUCIAL, ell, chi) == pytest.approx(limber(ell, chi), rel=0.02)
    power = np.concatenate([np.zeros(30), shear.linear_theory(FIDUCIAL, np.arange(30.0, 129.0), chi)])
    assert shear.band_ratio(FIDUCIAL, power, chi, (30, 64, 128)) == pytest.approx([1.0, 1.0], abs=1e-3)


@pytest.mark.nightly
def test_full_report(tmp_path):
    """Run every expectation with the default settings of a request; this takes a quarter of an hour on one core."""
    file = tmp_path / "universe.json"
    assert __main__.main(["--results", str(file), "--figures", str(tmp_path)]) == 0
    assert json.loads(file.read_text())["checks"] > 130
    assert (tmp_path / "universe.png").stat().st_size > 10_000
