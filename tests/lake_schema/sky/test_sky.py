"""Geometry of the sky, compared with astropy, healpy and closed forms."""

import astropy.units as u
import healpy as hp
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from hypothesis import example, given
from hypothesis import strategies as st

from lake_schema import sky
from lake_schema.errors import BadInput, OutOfRange

RA = st.floats(-360, 720)
DEC = st.floats(-90, 90)


@given(RA, DEC, st.floats(0, 30), st.integers(0, 8), st.integers(0, 2**32 - 1))
def test_a_cone_never_misses_a_cell(ra, dec, radius, order, seed):
    rng = np.random.default_rng(seed)
    around = SkyCoord(ra % 360 * u.deg, dec * u.deg).directional_offset_by(
        rng.uniform(0, 360, 200) * u.deg, radius * np.sqrt(rng.random(200)) * u.deg
    )
    cells = sky.cells_in_cone(ra, dec, radius, order)
    assert np.isin(sky.cell_at(around.ra.deg, around.dec.deg, order), cells).all()
    assert (np.diff(cells) > 0).all()


@pytest.mark.parametrize("cones", [1000, pytest.param(100_000, marks=pytest.mark.nightly)])
def test_no_cell_of_any_cone_is_missed(cones):
    """Random cones, many at the poles, on RA = 0, and on corners and edges of cells, with positions inside."""
    rng = np.random.default_rng(11)
    ra, dec = rng.uniform(0, 360, cones), np.degrees(np.arcsin(rng.uniform(-1, 1, cones)))
    special = rng.integers(0, 5, cones)
    dec = np.where(special == 0, np.sign(dec) * (90 - 10.0 ** rng.uniform(-9, 0, cones)), dec)
    ra = np.where(special == 1, 10.0 ** rng.uniform(-9, 0, cones) * rng.choice([-1, 1], cones), ra)
    corner = hp.vec2ang(hp.boundaries(32, rng.integers(0, 12288, cones), nest=True)[:, :, 0], lonlat=True)
    ra, dec = np.where(special == 2, corner[0], ra), np.where(special == 2, corner[1], dec)
    radius, order = 10.0 ** rng.uniform(-6, 0.5, cones), rng.integers(3, 10, cones)
    for i in range(cones):
        r = np.radians(radius[i]) * np.sqrt(np.append(rng.random(20), [1.0, 0.0]))
        bearing, lat = rng.uniform(0, 2 * np.pi, r.size), np.radians(dec[i])
        inside = np.arcsin(np.clip(np.sin(lat) * np.cos(r) + np.cos(lat) * np.sin(r) * np.cos(bearing), -1, 1))
        east = np.arctan2(np.sin(bearing) * np.sin(r) * np.cos(lat), np.cos(r) - np.sin(lat) * np.sin(inside))
        cells = sky.cell_at(ra[i] + np.degrees(east), np.degrees(inside), order[i])
        found = sky.cells_in_cone(ra[i], dec[i], radius[i], order[i])
        assert np.isin(cells, found).all(), (ra[i], dec[i], radius[i], order[i])


def test_a_cone_takes_few_cells_too_many():
    cells = sky.cells_in_cone(53.1, -27.8, 0.5, 8)
    centres = np.array([sky.cell_centre(8, c) for c in cells])
    assert (sky.separation(*centres.T, 53.1, -27.8) < 0.5 + 1.3 * sky.cell_radius(8)).all()


@given(RA, st.floats(-89, 89), st.floats(0.01, 5), st.integers(3, 12), st.integers(0, 9), st.integers(0, 2**32 - 1))
def test_a_polygon_never_misses_a_cell(ra, dec, size, corners, order, seed):
    rng = np.random.default_rng(seed)
    centre = SkyCoord(ra % 360 * u.deg, dec * u.deg)
    ring = centre.directional_offset_by(np.arange(corners) * 360 / corners * u.deg, size * u.deg)
    vectors = ring.cartesian.xyz.value.T
    weights = rng.dirichlet(np.ones(corners), 100)
    inside = weights @ vectors
    lon, lat = hp.vec2ang(inside, lonlat=True)
    cells = sky.cells_in_polygon(np.stack([ring.ra.deg, ring.dec.deg], 1), order)
    assert np.isin(sky.cell_at(lon, lat, order), cells).all()


def test_bad_polygons_are_refused():
    for polygon, words in (
        ([[0, 0], [1, 0]], "at least 3"),
        ([[0, 0], [1, 0], [1, 0]], "convex"),
        ([[0, 0], [2, 0], [1, 0.5], [2, 2]], "convex"),
    ):
        with pytest.raises(BadInput, match=words):
            sky.cells_in_polygon(polygon, 5)


@given(RA, DEC, RA, DEC)
def test_separation_agrees_with_astropy(ra1, dec1, ra2, dec2):
    theirs = SkyCoord(ra1 * u.deg, dec1 * u.deg).separation(SkyCoord(ra2 * u.deg, dec2 * u.deg)).deg
    assert sky.separation(ra1, dec1, ra2, dec2) == pytest.approx(theirs, abs=1e-12, rel=1e-10)


@pytest.mark.parametrize("tiny", [1e-9 / 3600, 1e-6, 1.0])
def test_separation_at_both_ends(tiny):
    assert sky.separation(10, 0, 10, tiny) == pytest.approx(tiny, rel=1e-12, abs=0.0)
    assert sky.separation(0, 0, 180, tiny) == pytest.approx(180 - tiny, rel=1e-12, abs=0.0)
    assert sky.separation(0, 90, 123, 90) == pytest.approx(0, abs=1e-13)
    assert sky.separation(0, 90, 77, -90) == pytest.approx(180)


@given(RA, DEC)
def test_galactic_agrees_with_astropy(ra, dec):
    ours = SkyCoord(*sky.galactic(ra, dec), unit="deg", frame="galactic")
    assert ours.separation(SkyCoord(ra, dec, unit="deg").galactic).arcsec < 0.05


@given(st.floats(-1e6, 1e6))
def test_a_wrapped_angle_is_below_a_full_turn(angle):
    for given_angle in (angle, -1e-300, np.float64(-1e-14)):
        assert 0.0 <= sky.wrap_angle(given_angle) < 360.0
    assert np.sin(np.radians(sky.wrap_angle(angle))) == pytest.approx(np.sin(np.radians(angle)), abs=1e-9)


@given(st.floats(-1e4, 1e4), st.sampled_from([np.float32, np.float64]))
@example(-1e-9, np.float32)
@example(-1e-9, np.float64)
@example(179.9999999, np.float64)
def test_a_position_angle_is_below_half_a_turn(angle, kind):
    found = sky.wrap_position_angle(np.array([angle], kind))
    assert found.dtype == np.float32
    assert 0.0 <= found[0] < 180.0
    assert np.sin(np.radians(2.0 * (found[0] - float(kind(angle))))) == pytest.approx(0.0, abs=1e-4)


@given(RA, DEC)
def test_equatorial_is_the_inverse_of_galactic(ra, dec):
    there = sky.equatorial(*sky.galactic(ra, dec))
    assert sky.separation(*there, ra, dec) * 3600 < 1e-6
    assert 0.0 <= there[0] < 360.0


@pytest.mark.parametrize(("ra", "dec"), [(np.nan, 0), (np.inf, 0), (0, np.nan), (0, 90.0000001), (0, -91)])
def test_positions_that_are_none_are_refused(ra, dec):
    with pytest.raises(OutOfRange):
        sky.healpix_29([ra], [dec])


def test_right_ascension_is_wrapped():
    ra, _ = sky.check_positions([-1e-20, -1e-9, 0, 360, 720, 359.5], [0] * 6)
    assert ((ra >= 0) & (ra < 360)).all()
    assert ra[[0, 2, 3, 4]].tolist() == [0, 0, 0, 0]
    assert ra[1] == pytest.approx(360)


@pytest.mark.parametrize("cell", [0, 1607, 8191])
def test_random_positions_are_uniform_and_sorted(cell):
    index, ra, dec = sky.random_in_cell(5, cell, 20_000, np.random.default_rng(1))
    assert (np.diff(index) >= 0).all()
    assert (sky.cell_at(ra, dec, 5) == cell).all()
    assert np.array_equal(sky.healpix_29(ra, dec), index)
    counts = np.bincount(sky.cell_at(ra, dec, 7) - 16 * cell, minlength=16)
    assert ((counts - 1250) ** 2 / 1250).sum() < 40  # chi2 of 15 degrees of freedom exceeds 40 once in 2000


def test_cells_tile_the_sphere():
    assert sky.cell_area(5) * 12 * 4**5 == pytest.approx(4 * np.pi * np.degrees(1) ** 2)
    first, last = sky.cell_range(8, 7)
    assert sky.parent([first, last - 1], 29, 8).tolist() == [7, 7]


@pytest.mark.parametrize("cell", [0, 1607, 12287, 4095])
def test_the_margin_holds_all_within_ten_arcsec(cell):
    """Random points just outside a cell's edge must be in its margin cells."""
    rim = sky.margin_cells(5, cell, 13)
    assert (sky.parent(rim, 13, 5) != cell).all()
    edge = hp.boundaries(32, cell, step=500, nest=True).T
    lon, lat = hp.vec2ang(edge, lonlat=True)
    rng = np.random.default_rng(cell)
    near = SkyCoord(lon, lat, unit="deg").directional_offset_by(
        rng.uniform(0, 360, lon.size) * u.deg, rng.uniform(0, 10, lon.size) * u.arcsec
    )
    outside = sky.cell_at(near.ra.deg, near.dec.deg, 5) != cell
    assert outside.sum() > 500
    assert np.isin(sky.cell_at(near.ra.deg[outside], near.dec.deg[outside], 13), rim).all()


@given(RA, st.floats(0.01, 179), DEC, st.floats(0.01, 60), st.integers(0, 6), st.integers(0, 2**32 - 1))
def test_a_box_never_misses_a_cell(west, span, south, height, order, seed):
    north = min(south + height, 90.0)
    rng = np.random.default_rng(seed)
    ra, dec = west + span * rng.random(200), south + (north - south) * rng.random(200)
    # The edges along parallels differ most from a polygon of great circles.
    dec[:40], dec[40:80], ra[80:120], ra[120:160] = south, north, west, west + span
    cells = sky.cells_in_box(west % 360, (west + span) % 360, south, north, order)
    assert np.isin(sky.cell_at(ra, dec, order), cells).all()
    assert (np.diff(cells) > 0).all()


def test_a_box_takes_few_cells_too_many():
    """The box has 380 deg2; the excess is at most one cell's width along its border of 96 deg."""
    area = len(sky.cells_in_box(0, 90, 60, 70, 7)) * sky.cell_area(7)
    assert 380 < area < 380 + 96 * np.sqrt(sky.cell_area(7)) * 1.1


@pytest.mark.parametrize("order", [0, 1, 2, 4, 9, 17, 29])
def test_corners_are_those_of_healpy(order):
    """All cells of low orders; of high orders some, and cells at the poles and along the edges of base cells."""
    healpy, number = pytest.importorskip("healpy"), 12 * 4**order
    some = np.random.default_rng(2).integers(number, size=3000)
    edges = [k * number // 12 + shift for k in range(13) for shift in (-1, 0) if 0 <= k * number // 12 + shift < number]
    cells = np.arange(number) if order < 5 else np.unique([*some, *edges])
    expected = np.moveaxis(healpy.boundaries(1 << order, cells, nest=True), 1, 2)
    places = np.stack(healpy.vec2ang(expected.reshape(-1, 3), lonlat=True), -1).reshape(-1, 4, 2)
    found = sky.cell_corners(order, cells)
    apart = sky.separation(found[..., 0].ravel(), found[..., 1].ravel(), *places.reshape(-1, 2).T)
    # The corners that healpy gives at the poles are up to 0.6 mas away from them.
    assert np.max(apart[np.abs(found[..., 1].ravel()) < 89.99]) < 1e-10
    assert np.max(apart) < 2e-7
    assert ((found[..., 0] >= 0.0) & (found[..., 0] < 360.0)).all()


@pytest.mark.parametrize("order", [0, 5, 12])
def test_corners_lie_about_the_centre(order):
    cells = np.arange(0, 12 * 4**order, max(1, 12 * 4**order // 20))
    corners = sky.cell_corners(order, cells)
    assert corners.shape == (len(cells), 4, 2)
    for cell, around in zip(cells, corners, strict=True):
        apart = sky.separation(*sky.cell_centre(order, int(cell)), around[:, 0], around[:, 1])
        assert (apart <= sky.cell_radius(order) * (1 + 1e-9)).all()
        assert (apart > 0.5 * np.sqrt(sky.cell_area(order) / 2)).all()


@pytest.mark.parametrize(("order", "number"), [(3, 40), (8, 4), pytest.param(8, 40, marks=pytest.mark.nightly)])
def test_cells_of_many_cones_are_those_of_each(order, number):
    """Small and large cones are compared with one call per cone, close together and far apart."""
    rng = np.random.default_rng(5)
    for ra, dec, spread in (
        (0.0, 89.9, 0.5),
        (359.9, 0.0, 0.5),
        (45.0, 41.8, 0.5),
        (12.0, -89.99, 0.1),
        (0.0, 0.0, 90.0),
    ):
        lon = ra + rng.uniform(-spread, spread, number) / max(np.cos(np.radians(dec)), 0.01)
        lat = np.clip(dec + rng.uniform(-spread, spread, number), -90.0, 90.0)
        radius = np.concatenate([rng.uniform(0.0, 0.4, number - 2), [0.0, 3.0]])
        found = sky.cells_in_cones(lon, lat, radius, order)
        assert [cells.tolist() for cells in found] == [
            sky.cells_in_cone(*place, order).tolist() for place in zip(lon, lat, radius, strict=True)
        ]
    assert sky.cells_in_cones([], [], [], order) == []
    with pytest.raises(OutOfRange, match="radius"):
        sky.cells_in_cones([0.0, 1.0], [0.0, 0.0], [0.1, -1.0], order)
