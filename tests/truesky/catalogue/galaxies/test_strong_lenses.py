"""Singular isothermal ellipsoids: rays against roots, circles against formulas, and how many there are."""

from dataclasses import asdict, replace

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from scipy.special import gamma

from lake_schema import sky
from lake_schema.store import plan, publish, read, validate
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.strong_lenses import STRONG_LENSES
from tests import requests
from tests.truesky import nightly
from tests.truesky.catalogue.conftest import FLAT_CELLS, SEED
from truesky.catalogue import build_strong_lenses
from truesky.catalogue.galaxies import strong_lenses
from truesky.catalogue.galaxies.strong_lenses import Disc, Lens
from truesky.catalogue.halos import luminosity_function
from truesky.cosmology import FIDUCIAL
from truesky.request.from_toml import parse

STAMPS = strong_lenses.stamps()
SIDE = 200
PIXEL = STAMPS.pixel_scale
BOOST = 7.0


def place(n=SIDE):
    return (np.arange(n) - 0.5 * (n - 1)) * PIXEL


@given(st.floats(0.3, 0.999), st.floats(0.0, 179.0), st.floats(-0.6, 0.6), st.floats(-0.6, 0.6))
@settings(max_examples=40, deadline=None)
def test_image_positions_solve_the_lens_equation(q, angle, east, north):
    lens = Lens(1.2, q, angle)
    found = strong_lenses.image_positions(lens, east, north)
    assert 1 <= len(found) <= 4
    x, y = strong_lenses.deflection(lens, found[:, 0], found[:, 1])
    assert found[:, 0] - x == pytest.approx(east, abs=1e-9)
    assert found[:, 1] - y == pytest.approx(north, abs=1e-9)


def test_a_sphere_has_the_known_images():
    """theta = beta +- theta_E, magnified by 1 +- theta_E / beta and of opposite parity."""
    lens = Lens(1.3, 0.999_999, 20.0)
    found = strong_lenses.image_positions(lens, 0.3, 0.4)
    radius = np.sort(found @ np.array([0.6, 0.8]))
    assert radius == pytest.approx([0.5 - 1.3, 0.5 + 1.3], abs=1e-4)
    mu = np.sort(strong_lenses.magnification(lens, found[:, 0], found[:, 1]))
    assert mu == pytest.approx([1 - 1.3 / 0.5, 1 + 1.3 / 0.5], rel=1e-3)


def test_the_deflection_diverges_as_the_convergence():
    """div alpha = 2 kappa, and no curl, by differences."""
    lens, at, step = Lens(1.0, 0.7, 35.0), np.array([[0.8, 0.5], [-1.2, 0.9], [0.1, -1.4]]), 1e-5
    grad = np.empty((3, 2, 2))
    for axis in (0, 1):
        shift = np.eye(2)[axis] * step
        ahead, behind = (strong_lenses.deflection(lens, *(at + sign * shift).T) for sign in (1, -1))
        grad[:, :, axis] = (np.array(ahead) - np.array(behind)).T / (2 * step)
    kappa = 0.5 * (1.0 - 1.0 / strong_lenses.magnification(lens, *at.T))
    assert grad[:, 0, 0] + grad[:, 1, 1] == pytest.approx(2 * kappa, rel=1e-6)
    assert grad[:, 0, 1] == pytest.approx(grad[:, 1, 0], abs=1e-8)


@nightly.parametrize(
    ("lens", "east", "north"),
    [(Lens(1.2, 0.7, 30.0), 0.02, 0.03), (Lens(1.5, 0.6, 120.0), 0.5, 0.1), (Lens(0.9, 0.8, 0.0), -0.2, 0.4)],
    (0,),
)
def test_rays_end_at_the_analytic_images(lens, east, north):
    """A small source has one spot per image, at the expected position and with the flux of its magnification."""
    picture = strong_lenses.shoot_rays(lens, Disc(east, north, 0.02, 1.0, 0.0), STAMPS, SIDE)
    found = strong_lenses.image_positions(lens, east, north)
    mu = np.abs(strong_lenses.magnification(lens, found[:, 0], found[:, 1]))
    assert picture.sum() == pytest.approx(mu.sum(), rel=0.02)
    north_at, east_at = np.meshgrid(place(), place(), indexing="ij")
    nearest = np.argmin([np.hypot(east_at - x, north_at - y) for x, y in found], axis=0)
    for number, (x, y) in enumerate(found):
        part = np.where(nearest == number, picture, 0.0)
        middle = ndimage.center_of_mass(part)
        assert part.sum() == pytest.approx(mu[number], rel=0.03)
        assert np.interp(middle, np.arange(SIDE), place()) == pytest.approx((y, x), abs=0.25 * PIXEL)


def test_finer_rays_do_not_change_the_picture():
    lens, source = Lens(1.2, 0.75, 40.0), Disc(0.15, -0.1, 0.2, 0.6, 70.0)
    coarse = strong_lenses.shoot_rays(lens, source, STAMPS, SIDE)
    fine = strong_lenses.shoot_rays(lens, source, replace(STAMPS, samples=(16, 16)), SIDE)
    assert coarse.sum() == pytest.approx(fine.sum(), rel=1e-3)
    assert np.abs(coarse - fine).sum() < 5e-3 * fine.sum()


def test_magnification_is_1_far_from_the_lens():
    weak = strong_lenses.shoot_rays(Lens(1e-3, 0.8, 0.0), Disc(0.4, 0.3, 0.3, 0.5, 30.0), STAMPS, SIDE)
    assert weak.sum() == pytest.approx(1.0, abs=3e-3)
    middle = ndimage.center_of_mass(weak)
    assert np.interp(middle, np.arange(SIDE), place()) == pytest.approx((0.3, 0.4), abs=2e-3)


def test_einstein_radius_of_a_massive_galaxy():
    """1.154 arcsec of an infinitely far source; D_ls / D_s = 0.632 (Omega_m = 0.319)."""
    assert strong_lenses.einstein_radius(FIDUCIAL, 200.0, 0.5, 2.0) == pytest.approx(1.154 * 0.632, abs=0.005)
    assert strong_lenses.einstein_radius(FIDUCIAL, 200.0, 0.5, 0.4) == 0.0


@pytest.fixture(scope="module")
def systems(drawn):
    """Return the lenses of two cells, and their area (deg2)."""
    return draw_systems(drawn, 2)


def draw_systems(drawn, count):
    """Draw many more lenses than in nature in some of the cells that were drawn."""
    index = drawn.rows["_healpix_29"].to_numpy() >> 2 * (sky.MAX_ORDER - 8)
    found = [
        strong_lenses.draw(cell, drawn.rows.filter(pa.array(index == cell)), SEED, BOOST, FIDUCIAL)
        for cell in drawn.places[:count]
    ]
    return pa.concat_tables(found), count * sky.cell_area(8)


def test_dispersions_are_those_of_nearby_galaxies(flat_sky):
    """sum of (sigma / 161 km/s)^4, (Mpc/h)^-3: Choi, Park & Vogeley 2007 have phi* Gamma((alpha + 4) / beta) / ...

    In a sky without structure: one cluster of a degree2 moves the sum by a tenth.
    """
    law, rows = strong_lenses.laws(), flat_sky
    z, m_r, colour = (rows[name].to_numpy().astype(float) for name in ("z_true", "abs_mag_r01", "color_gr_01"))
    phi, alpha, beta = 8.0e-3, 2.32, 2.67
    expected = phi * gamma((alpha + 4.0) / beta) / gamma(alpha / beta)
    near = (z > 0.1) & (z < 0.7) & (colour > law.reddest_blue)
    m_star, _, _ = luminosity_function.schechter().parameters_at(z[near])
    fourth = 10.0 ** (0.4 * (m_star - m_r[near])) * np.exp(8.0 * (law.scatter * np.log(10.0)) ** 2)
    volume = float(FIDUCIAL.comoving_volume(0.1, 0.7)) * np.radians(1.0) ** 2 * FLAT_CELLS * sky.cell_area(8)
    assert law.sigma_star == 161.0
    assert fourth.sum() / volume == pytest.approx(expected, rel=0.15)


def signal_to_noise(stamp, mag):
    """Return the signal-to-noise ratio of arcs over the best choice of pixels, as Collett 2015 does for Euclid."""
    side = int(np.sqrt(len(stamp)))
    picture = np.reshape(stamp, (side // 2, 2, side // 2, 2)).sum((1, 3))
    picture = ndimage.gaussian_filter(picture, 0.18 / 2.3548 / 0.1)
    electrons = np.sort(picture.ravel())[::-1] * 1610.0 * 10.0 ** (-0.4 * (mag - 25.5))
    background = 1610.0 * 0.01 * 10.0 ** (-0.4 * (22.2 - 25.5)) + 4 * 4.5**2
    total, pixels = np.cumsum(electrons), np.arange(1, electrons.size + 1)
    return np.max(total / np.sqrt(total + background * pixels))


def test_there_are_about_as_many_as_expected(systems):
    """Systems of all sizes; the nightly test compares those that are found with the published number."""
    rows, area = systems
    assert 5.0 < rows.num_rows / area / BOOST < 60.0


@pytest.mark.nightly
def test_there_are_as_many_as_expected(drawn):
    """Collett 2015: 170,000 in 15,000 deg2, found at S/N > 20, resolved, stretched and magnified three times."""
    rows, area = draw_systems(drawn, 8)
    mag = dict(zip(drawn.columns["id"].tolist(), drawn.mags["euclid_vis"], strict=True))
    size = dict(zip(drawn.columns["id"].tolist(), drawn.columns["disk_half_light_radius"], strict=True))
    source = rows["source_id"].to_pylist()
    deep = [signal_to_noise(stamp, mag[i]) for stamp, i in zip(rows["stamp"].to_pylist(), source, strict=True)]
    radius, magnified = rows["einstein_radius"].to_numpy(), rows["magnification"].to_numpy()
    r = np.array([size[i] for i in source])
    found = (np.array(deep) > 20.0) & (np.hypot(r, 0.09) < radius) & (magnified * r > 0.18)
    assert 5.0 < rows.num_rows / area / BOOST < 60.0
    assert found.sum() / area / BOOST == pytest.approx(11.3, rel=0.5)


def test_an_empty_cell_has_none():
    rows = strong_lenses.draw(7, GALAXIES.empty(), SEED, 1.0, FIDUCIAL)
    assert rows.num_rows == 0
    assert validate.find_violations(rows, STRONG_LENSES) == []


def test_rows_are_what_the_table_declares(systems, drawn):
    rows, _ = systems
    assert validate.find_violations(rows, STRONG_LENSES) == []
    magnification = rows["magnification"].to_numpy()
    assert magnification.min() > 3.0
    assert rows["einstein_radius"].to_numpy().min() > 0.5
    assert (rows["z_source"].to_numpy() > rows["z_lens"].to_numpy() + 0.199).all()
    assert np.isin(rows["lens_id"].to_numpy(), drawn.rows["id"].to_numpy()).all()
    assert np.isin(rows["source_id"].to_numpy(), drawn.rows["id"].to_numpy()).all()
    for side, stamp, total in zip(
        *(rows[n].to_pylist() for n in ("stamp_side", "stamp", "magnification")), strict=True
    ):
        assert len(stamp) == side**2
        assert sum(stamp) == pytest.approx(total, rel=1e-3)


def test_a_published_table(tmp_path, drawn):
    index, cell = drawn.rows["_healpix_29"].to_numpy(), drawn.places[0]
    own = drawn.rows.filter(pa.array(index >> 2 * (sky.MAX_ORDER - 8) == cell))
    name = f"Norder=5/Dir=0/Npix={cell >> 6}.parquet"
    part = plan.Task(name, {"generation_cells": [cell]})
    publish.make_version(
        tmp_path,
        plan.Plan(GALAXIES, {"seed": 7, "cosmology": asdict(FIDUCIAL)}, (part,)),
        lambda lake, facts: plan.Output(own),
    )
    path = requests.written(tmp_path, "[strong_lenses]\nboost = 3.0\n", seed=7)
    (step,) = build_strong_lenses.steps(tmp_path, parse(path))
    publish.make_version(tmp_path, step.plan, step.run_task)
    rows = read.version(tmp_path, "strong_lenses").rows()
    assert rows.num_rows > 0
    assert rows.equals(strong_lenses.draw(cell, own, 7, 3.0, FIDUCIAL))
