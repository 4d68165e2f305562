"""Signs and sizes against a lens of known mass; power against linear theory."""

from dataclasses import replace

import healpy as hp
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lake_schema import sky
from lake_schema.errors import BadInput
from truesky.catalogue.galaxies import galaxies, lensing
from truesky.catalogue.matter import density_box
from truesky.cosmology import FIDUCIAL
from truesky.fluxes import sources
from truesky.render.sources import galaxy_shapes
from truesky.request.schema import MAX_SHEAR

BUMP_NSIDE = 128
RA, DEC, WIDTH = 40.0, 20.0, np.radians(2.0)


@pytest.fixture(scope="module")
def bump():
    """Lensing by a round lens: kappa a Gaussian of 2 deg about (40, 20)."""
    ra, dec = hp.pix2ang(BUMP_NSIDE, np.arange(12 * BUMP_NSIDE**2), nest=True, lonlat=True)
    angle = np.radians(sky.separation(ra, dec, RA, DEC))
    kappa = 0.1 * np.exp(-0.5 * (angle / WIDTH) ** 2)
    fields = lensing.maps_of_convergence(kappa.astype(np.float32), BUMP_NSIDE, np.ones(2 * BUMP_NSIDE + 1))
    return lensing.Planes(BUMP_NSIDE, np.array([1000.0]), (fields,))


def at(planes, east, north):
    """Fields at offsets, deg, from the lens."""
    ra = RA + east / np.cos(np.radians(DEC))
    return lensing.interpolate(planes, np.array([ra]), np.array([DEC + north]), np.array([1000.0]))[:, 0]


def test_shear_is_tangential(bump):
    """Negative gamma1 east and west of a mass, positive north and south; gamma2 negative north-east."""
    for east, north, first, second in (
        (3, 0, -1, 0), (-3, 0, -1, 0), (0, 3, 1, 0), (0, -3, 1, 0), (2, 2, 0, -1), (-2, -2, 0, -1), (2, -2, 0, 1),
    ):  # fmt: skip
        gamma1, gamma2 = at(bump, east, north)[1:3]
        assert gamma1 == pytest.approx(0.0, abs=2e-3) if first == 0 else first * gamma1 > 0.005
        assert gamma2 == pytest.approx(0.0, abs=2e-3) if second == 0 else second * gamma2 > 0.005


def test_shear_and_deflection_have_the_size_of_the_lens(bump):
    """gamma_t(r) = mean kappa inside r - kappa(r); alpha(r) = r mean kappa inside r (flat sky)."""
    r = np.radians(3.0)
    x = 0.5 * (r / WIDTH) ** 2
    inside, here = 0.1 * -np.expm1(-x) / x, 0.1 * np.exp(-x)
    kappa, gamma1, _, _, north = at(bump, 0.0, 3.0)
    assert kappa == pytest.approx(here, rel=0.03)
    assert gamma1 == pytest.approx(inside - here, rel=0.05)
    assert north == pytest.approx(r * inside, rel=0.05)


def test_sources_are_pushed_away(bump):
    for east, north in ((3, 0), (-3, 0), (0, 3), (0, -3)):
        fields = at(bump, east, north)
        ra, dec = RA + east / np.cos(np.radians(DEC)), DEC + north
        moved = lensing.displace(np.array([ra]), np.array([dec]), fields[3:4], fields[4:5])
        before, after = sky.separation(ra, dec, RA, DEC), sky.separation(moved[0], moved[1], RA, DEC)
        assert 0.1 < after - before < 0.5


@pytest.mark.parametrize("dec", [-90.0, -45.0, 0.0, 89.9])
def test_displacements_are_great_circles(dec, rng):
    east, north = 0.002 * rng.standard_normal((2, 50))
    ra = 360.0 * rng.random(50)
    lon, lat = lensing.displace(ra, np.full(50, dec), east, north)
    assert sky.separation(ra, np.full(50, dec), lon, lat) == pytest.approx(np.degrees(np.hypot(east, north)), rel=1e-6)
    assert np.all((lon >= 0) & (lon < 360))
    if abs(dec) < 80:
        assert (lat - dec) == pytest.approx(np.degrees(north), abs=3e-3)


@pytest.mark.parametrize("dec", [-90.0, 0.0, 90.0])
def test_right_ascensions_are_below_360(dec):
    """True and observed right ascensions of positions that move across the meridian of 0 by tiny steps."""
    ra = np.array([0.0, -0.0, -1e-300, -1e-16, 360.0, np.nextafter(360.0, 0.0), 720.0])
    for east in (-1e-3, -1e-18, 0.0, 1e-18, 1e-3):
        seen = lensing.displace(ra, np.full(ra.size, dec), np.full(ra.size, east), np.zeros(ra.size))
        columns = lensing.position_columns(seen, (ra, np.full(ra.size, dec)))
        for name in ("ra", "ra_true"):
            assert np.all((columns[name] >= 0.0) & (columns[name] < 360.0))
        assert np.array_equal(columns["_healpix_29"], sky.healpix_29(columns["ra"], columns["dec"]))


def test_interpolation_in_distance(bump):
    half = lensing.interpolate(bump, np.array([RA]), np.array([DEC]), np.array([500.0]))
    whole = lensing.interpolate(bump, np.array([RA]), np.array([DEC]), np.array([1000.0]))
    assert half == pytest.approx(0.5 * whole, rel=1e-9, abs=0.0)
    assert not lensing.interpolate(bump, np.array([RA]), np.array([DEC]), np.array([0.0])).any()


def limber(ell, chi):
    """C_l of kappa, linear theory, one source plane."""
    x = np.linspace(5.0, chi - 1.0, 1000)
    z = FIDUCIAL.redshift(x)
    weight = 1.5 * 0.319 / 2997.92458**2 * x * (chi - x) / chi * (1 + z) * FIDUCIAL.growth(z)
    k = (np.asarray(ell)[:, None] + 0.5) / x
    power = density_box.linear_power(FIDUCIAL, k.ravel()).reshape(k.shape) * (k < np.pi / 4.0 * 1.5)
    return np.trapezoid((weight / x) ** 2 * power, x, axis=1)


def test_power_and_modes_of_the_universe(universe):
    """C_l of kappa within 10 % of linear theory for 30 < l < nside; no B modes; gamma = what kappa says.

    Sample of two planes with about 500 independent places; significance 3e-3 of the mean (3 standard errors).
    """
    planes = universe.lens
    for number in (7, 12):
        kappa, gamma1, gamma2 = (hp.reorder(planes.maps[number][:, i].astype(float), n2r=True) for i in range(3))
        power = hp.anafast(kappa, lmax=90, iter=2)
        for low, high in ((30, 64),):
            ell = np.arange(low, high)
            ratio = power[low:high].mean() / limber(ell[::4], planes.chi[number]).mean()
            assert ratio == pytest.approx(1.0, abs=0.10)
        e_mode, b_mode = hp.map2alm_spin([gamma1, gamma2], 2, lmax=90)
        assert np.sum(np.abs(b_mode) ** 2) < 0.01 * np.sum(np.abs(e_mode) ** 2)
        assert abs(kappa.mean()) < 3 * kappa.std() / np.sqrt(500)


def test_tangential_shear_about_massive_halos(universe, drawn):
    """Behind halos of 10^13.3 Msun/h at 0.2 < z < 0.8 sources at z = 1.2 are sheared tangentially on average."""
    halos = drawn.halos
    heavy = (halos["log_mass"].to_numpy() > 13.3) & (halos["z_true"].to_numpy() > 0.2)
    heavy &= halos["z_true"].to_numpy() < 0.8
    ra, dec = halos["ra"].to_numpy()[heavy], halos["dec"].to_numpy()[heavy]
    shear = []
    for angle in np.arange(8) * np.pi / 4:
        east, north = 1.0 * np.sin(angle), 1.0 * np.cos(angle)
        found = lensing.interpolate(
            universe.lens, ra + east / np.cos(np.radians(dec)), dec + north, np.full(ra.size, 2600.0)
        )
        # Position angle from north to east; gamma1 > 0 is north-south.
        shear.append(found[1] * np.cos(2 * angle) - found[2] * np.sin(2 * angle))
    assert ra.size > 20
    assert np.mean(shear) > 0


def test_determinants_and_caustics():
    kappa, none = np.array([0.0, 0.1, 0.95, 1.2]), np.zeros(4)
    assert sources.determinant(kappa, none, none) == pytest.approx([1.0, 0.81, 0.0025, 0.04])
    assert sources.determinant(np.array([0.1]), np.array([0.3]), np.array([0.4])) == pytest.approx([0.81 - 0.25])
    assert lensing.is_near_caustic(kappa, none, none, 0.05).tolist() == [False, False, True, True]
    # Beyond both caustics the determinant is positive again.
    assert lensing.is_near_caustic(np.array([2.5]), none[:1], none[:1], 0.05).all()


def test_a_resolution_that_healpix_has_not_is_refused(box):
    with pytest.raises(BadInput, match="lensing_nside = 100"):
        lensing.load(box, 100)


CELL = 303_117
LENSED = ("ra", "dec", "_healpix_29", "a_v", "kappa", "gamma1", "gamma2")


@pytest.fixture(scope="module")
def drawn_with(universe, cells, dust):
    """Galaxies of one cell, with another lensing or rotation of the same universe."""
    return lambda **changed: galaxies.draw(CELL, replace(universe, **changed), cells, dust).sort_by("id")


@pytest.fixture(scope="module")
def unlensed(drawn_with):
    return drawn_with(lens=lensing.Shear())


def ellipticities(rows):
    """Complex ellipticities (a - b) / (a + b) of bulges, of discs as they are drawn, from west to north."""
    forms = galaxy_shapes.forms(galaxy_shapes.shapes(rows), np.broadcast_to(np.eye(2), (len(rows), 2, 2)))
    for axes in (forms.bulge, forms.disk):
        second = axes @ axes.swapaxes(1, 2)
        xx, xy, yy = second[:, 0, 0], second[:, 0, 1], second[:, 1, 1]
        yield (xx - yy + 2j * xy) / (xx + yy + 2 * np.abs(np.linalg.det(axes)))


def test_without_lensing_everything_else_is_the_same(drawn_with, unlensed):
    lensed = drawn_with()
    assert len(lensed) > 1000
    for name in lensed.column_names:
        assert lensed[name].equals(unlensed[name]) == (name not in LENSED), name
    assert unlensed["ra_true"].equals(unlensed["ra"])
    assert unlensed["dec_true"].equals(unlensed["dec"])
    assert all(np.all(unlensed[name].to_numpy() == 0) for name in LENSED[4:])


@settings(max_examples=5)
@given(size=st.floats(0.0, MAX_SHEAR - 1e-6), angle=st.floats(0.0, 6.3))
def test_a_constant_shear_acts_on_every_ellipticity(drawn_with, unlensed, size, angle):
    """e -> (e + g) / (1 + g* e), at the same places; g2 is of (east, north), shapes are drawn in (west, north)."""
    g1, g2 = size * np.cos(angle), size * np.sin(angle)
    rows = drawn_with(lens=lensing.Shear(g1, g2))
    assert [n for n in rows.column_names if not rows[n].equals(unlensed[n])] in ([], ["gamma1"], ["gamma1", "gamma2"])
    g = np.complex128(np.float32(g1) - 1j * np.float32(g2))
    for before, after in zip(ellipticities(unlensed), ellipticities(rows), strict=True):
        np.testing.assert_allclose(after, (before + g) / (1 + np.conj(g) * before), rtol=0, atol=1e-6)
    mu = sources.table_magnification(rows)
    np.testing.assert_allclose(mu, 1 / (1 - abs(g) ** 2), rtol=1e-5)


def test_positive_shears_stretch_east_west_and_to_the_north_east(drawn_with):
    for shear, direction in (((0.3, 0.0), 1.0), ((0.0, 0.3), -1j)):
        rows = drawn_with(lens=lensing.Shear(*shear))
        (stretched, _) = ellipticities(rows)
        assert np.mean((stretched / direction).real) == pytest.approx(0.3, abs=0.03)


def test_a_rotation_by_90_degrees_turns_the_intrinsic_ellipticity_alone(drawn_with, unlensed):
    turned = drawn_with(lens=lensing.Shear(), rotation=90.0)
    assert [name for name in turned.column_names if not turned[name].equals(unlensed[name])] == ["position_angle"]
    for before, after in zip(ellipticities(unlensed), ellipticities(turned), strict=True):
        np.testing.assert_allclose(after, -before, atol=1e-6)
    lensed, both = drawn_with(), drawn_with(rotation=90.0)
    assert all(lensed[name].equals(both[name]) for name in LENSED)
    assert not lensed["position_angle"].equals(both["position_angle"])


def test_requests_are_refused_where_ellipses_are_not_drawn():
    assert lensing.settings().caustic < 1.0 - MAX_SHEAR**2


def test_an_axis_that_is_turned_by_next_to_nothing_stays_below_half_a_turn():
    rows = pa.table({"position_angle": pa.array([0.0, 90.0], pa.float32())})
    assert lensing.rotate_position_angles(rows, -1e-9)["position_angle"].to_pylist() == [0.0, 90.0]
