"""Band fluxes of extreme inputs are finite and monotone, or the input is refused by name."""

from decimal import Decimal, localcontext

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lake_schema import units
from lake_schema.errors import BadInput, OutOfRange
from truesky.cosmology import FIDUCIAL, HUBBLE_DISTANCE
from truesky.fluxes import band_fluxes, high_redshift, passbands, sources
from truesky.fluxes.libraries import templates
from truesky.fluxes.passbands import Passband
from truesky.fluxes.spectra import extinction, lines
from truesky.request.accuracy import REFERENCE, SURVEY

BANDS = ("euclid_vis", "lsst_u", "euclid_h")
PLAIN = {
    "kind": 0, "z_obs": 0.5, "abs_mag_r01": -20.0, "mag_r01": 22.0, "kappa": 0.0, "gamma1": 0.0, "gamma2": 0.0,
    "a_v": 0.0,
    "sed_1": 10, "sed_2": 9, "frac_1": 0.4, "frac_2": 0.6, "ext_law_1": 2, "ext_law_2": 2, "ebv_1": 0.1, "ebv_2": 0.1,
}  # fmt: skip


@pytest.fixture(scope="module")
def library():
    return templates.galaxy_library()


def galaxies(**columns):
    n = max(np.size(value) for value in columns.values())
    place = {"id": np.arange(n), "ra": np.zeros(n), "dec": np.zeros(n), "_healpix_29": np.arange(n)}
    return pa.table(place | {name: np.broadcast_to(value, n) for name, value in (PLAIN | columns).items()})


def fluxes(library, accuracy=SURVEY, **columns):
    made = band_fluxes.galaxy_fluxes(galaxies(**columns), BANDS, library, accuracy)
    return np.stack([made[f"f_nu_{band}"].to_numpy().astype(float) for band in BANDS], 1)


@pytest.mark.parametrize("sed", [0, 30])
@pytest.mark.parametrize("ebv", [0.0, 0.6, 3.0])
@pytest.mark.parametrize("law", range(5))
def test_corners_of_redshift_and_dust(library, sed, ebv, law):
    z = np.tile([-0.02, 0.0, 1e-8, 2.3, 3.0], 3)
    corner = {"z_obs": z, "a_v": np.repeat([0.0, 1.55, 30.0], 5), "sed_1": sed, "sed_2": sed}
    corner |= {"ext_law_1": law, "ext_law_2": law, "ebv_1": ebv, "ebv_2": ebv}
    if law == 1 and ebv == 3.0:
        # The law of Prevot leaves 1e-12 of the far ultraviolet: still numbers, as small as they are.
        corner["z_obs"] = np.minimum(z, 1.0)
    fast, slow = (fluxes(library, accuracy, **corner) for accuracy in (SURVEY, REFERENCE))
    assert np.isfinite(fast).all()
    assert (fast >= 0.0).all()
    np.testing.assert_allclose(fast, slow, rtol=SURVEY.flux, atol=1e-36)


def test_redshift_zero_is_the_limit(library):
    at = fluxes(library, z_obs=np.array([0.0, 1e-8, 1e-6]))
    np.testing.assert_allclose(at[1], at[0], rtol=1e-6)
    np.testing.assert_allclose(at[2], at[0], rtol=1e-4)


def test_tables_are_continuous_at_their_ends(library):
    for name, ends in (("z_obs", (3.03 - 1e-6, 3.03 + 1e-6)), ("a_v", (1.55 - 1e-6, 1.55 + 1e-6))):
        inside, outside = fluxes(library, **{name: np.array(ends)})
        np.testing.assert_allclose(outside, inside, rtol=2e-3)
    inside, outside = fluxes(library, ebv_1=np.array([0.6 - 1e-6, 0.6 + 1e-6]))
    np.testing.assert_allclose(outside, inside, rtol=2e-3)


def test_more_dust_of_the_milky_way_is_fainter(library):
    assert (np.diff(fluxes(library, a_v=np.linspace(0.0, 40.0, 200)), axis=0) < 0.0).all()


def test_more_internal_dust_is_redder(library):
    ebv = np.concatenate([np.linspace(0.0, 0.6, 30), np.linspace(0.61, 3.0, 20)])
    got = fluxes(library, ebv_1=ebv, ebv_2=ebv)
    assert (np.diff(got[:, 2] / got[:, 0]) > 0.0).all()


@pytest.mark.parametrize("accuracy", [SURVEY, REFERENCE])
@pytest.mark.parametrize("band", [0, 2])
def test_a_line_that_crosses_a_bands_edge(library, accuracy, band):
    curve = passbands.load(BANDS[band])
    half = np.flatnonzero(curve.response > 0.5 * curve.response.max())
    for edge in curve.wavelength[half[[0, -1]]]:
        rest, column = (4862.721, "flux_hbeta") if edge < 16_000.0 else (6564.614, "flux_halpha")
        z = edge / rest - 1.0 + np.linspace(-2e-2, 2e-2, 41)
        dark, lit = (fluxes(library, accuracy, z_obs=z, mag_r01=28.0, **{column: flux}) for flux in (0.0, 1e-16))
        assert (lit >= dark).all()
        seen = 1e-16 * np.interp(rest * (1.0 + z), curve.wavelength, passbands.weights(curve))
        # The wings of the line sample neighbouring wavelengths, whose response differs by a few per cent.
        best = units.ujy_of_cgs(1e-16 * passbands.weights(curve).max())
        assert np.abs(lit[:, band] - dark[:, band] - units.ujy_of_cgs(seen)).max() < 0.03 * best


@given(st.floats(0.0, 3.0), st.floats(-30.0, 5.0))
@settings(max_examples=25)
def test_a_line_narrower_than_the_grid_keeps_its_flux(z, abs_mag):
    sigma = lines.velocity_dispersion([abs_mag], [z])
    flux = np.zeros((1, len(lines.line_list())))
    flux[0, 0] = 1e-16
    for width in (sigma, np.array([1e-3])):
        found = lines.profiles(flux, np.array([z]), width, "vacuum")
        assert found.f_lambda.sum() == pytest.approx(1e-16, rel=1e-12, abs=0.0)


@pytest.mark.parametrize("sigma_a", [0.1, 1.0, 30.0, 1000.0])
@pytest.mark.parametrize("step", [1, 5, 20])
def test_lines_keep_their_flux_on_any_grid(sigma_a, step):
    # Bins of 1 A add up to the bins of any coarser grid.
    z = np.array([1.0])
    sigma = np.array([sigma_a / (6564.614 * 2.0) * units.LIGHT_KM_S])
    flux = np.zeros((1, len(lines.line_list())))
    flux[0, 0] = 1.0
    found = lines.profiles(flux, z, sigma, "vacuum")
    bins = np.bincount(
        (found.first[0] + np.arange(found.f_lambda.shape[1])) // step - found.first[0] // step, found.f_lambda[0]
    )
    assert bins.sum() == pytest.approx(1.0, rel=1e-12)


def test_zero_and_tiny_lines(library):
    none = fluxes(library, mag_r01=30.0, flux_halpha=0.0)
    tiny = fluxes(library, mag_r01=30.0, flux_halpha=1e-30)
    np.testing.assert_allclose(tiny, none, rtol=1e-6)
    assert (fluxes(library, mag_r01=60.0, flux_halpha=0.0) > 0.0).all()


@pytest.mark.parametrize("mag", [-5.0, 60.0])
def test_bright_and_faint_scale(library, mag):
    np.testing.assert_allclose(
        fluxes(library, mag_r01=mag), fluxes(library, mag_r01=22.0) * 10.0 ** (-0.4 * (mag - 22.0)), rtol=1e-6
    )


def test_absolute_magnitudes_only_shape_the_lines(library):
    got = fluxes(library, abs_mag_r01=np.linspace(-30.0, 0.0, 61), flux_halpha=1e-16)
    assert np.isfinite(got).all()
    assert np.ptp(got / got[0]) < 0.01


@pytest.mark.parametrize("kappa", [0.899, -1.0])
def test_just_inside_the_critical_curve(library, kappa):
    got = fluxes(library, kappa=kappa)
    np.testing.assert_allclose(got, fluxes(library, kappa=0.0) / (1.0 - kappa) ** 2, rtol=1e-5)


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("kappa", 0.95), ("kappa", 1.0), ("gamma1", 1.0), ("kappa", np.nan), ("a_v", 40.1), ("a_v", -1e-3),
        ("ebv_1", 3.1), ("ebv_2", -0.1), ("z_obs", -0.1), ("z_obs", 14.0), ("sed_1", 31), ("sed_2", -1),
        ("ext_law_1", 5), ("frac_1", 1.1),
        ("mag_r01", 61.0), ("abs_mag_r01", -31.0), ("flux_halpha", -1e-18), ("flux_halpha", np.inf), ("kind", 7),
    ],
)  # fmt: skip
def test_values_outside_the_limits_are_refused_by_name(library, column, value):
    with pytest.raises(
        BadInput, match="magnification" if column in ("kappa", "gamma1") and np.isfinite(value) else column
    ):
        fluxes(library, **{column: value})


def test_redshift_14():
    far = galaxies(kind=3, z_obs=14.0, frac_1=1.0, frac_2=0.0, ebv_1=0.0, sed_1=7, mag_r01=27.0)
    got = high_redshift.fluxes(far, [passbands.load(name) for name in ("euclid_vis", "euclid_h", "twomass_ks")])[0]
    # Lyman alpha is at 18235 A.
    assert got[0] == 0.0
    assert 0.0 < got[1] < got[2]


@given(st.floats(-0.4, 0.4), st.floats(-0.25, 0.25), st.floats(-0.25, 0.25))
def test_shear_has_no_sign(kappa, gamma1, gamma2):
    one = sources.magnification([kappa], [gamma1], [gamma2], [0])
    other = sources.magnification([kappa], [-gamma1], [-gamma2], [0])
    assert one[0] == other[0] > 0.0


@given(st.floats(-1e-3, 1e-3), st.floats(-1e-3, 1e-3), st.floats(-1e-3, 1e-3))
def test_an_opposite_lens_undoes_a_weak_one(kappa, gamma1, gamma2):
    there = sources.magnification([kappa], [gamma1], [gamma2], [0])
    back = sources.magnification([-kappa], [-gamma1], [-gamma2], [0])
    assert there[0] * back[0] == pytest.approx(1.0, abs=1e-5)


@given(st.integers(0, 4), st.floats(0.0, 3.0), st.floats(0.0, 3.0))
def test_extinction_is_monotone_and_one_without_dust(law, ebv, more):
    k = extinction.laws(np.linspace(100.0, 24000.0, 300))[law]
    assert (extinction.transmission(k, 0.0) == 1.0).all()
    assert (extinction.transmission(k, max(ebv, more)) <= extinction.transmission(k, min(ebv, more))).all()


@given(st.floats(-30.0, 60.0))
def test_magnitude_and_flux_are_inverse(mag):
    assert float(units.mag_of_f_nu(units.f_nu_of_mag(mag))) == pytest.approx(mag, abs=1e-12)
    with localcontext(prec=50):
        exact = Decimal(10) ** (-(Decimal(mag) + Decimal("48.6")) / Decimal("2.5")) * Decimal(10) ** 29
    assert float(units.f_nu_of_mag(mag)) == pytest.approx(float(exact), rel=1e-12, abs=0.0)


@pytest.mark.parametrize("z", [1e-8, 1e-4, 0.1, 1.0, 5.0, 14.0, 20.0])
def test_luminosity_distance_is_the_integral(z):
    # Simpson's rule, in the redshift itself.
    x = np.linspace(0.0, z, 20_001)
    rate = 1.0 / np.sqrt(FIDUCIAL.omega_m * (1.0 + x) ** 3 + FIDUCIAL.omega_lambda)
    simpson = (rate[0] + rate[-1] + 4.0 * rate[1:-1:2].sum() + 2.0 * rate[2:-1:2].sum()) * z / 60_000.0
    exact = (1.0 + z) * HUBBLE_DISTANCE * simpson
    assert float(FIDUCIAL.luminosity_distance(z)) == pytest.approx(exact, rel=1e-8, abs=0.0)
    if z <= 1e-8:
        assert float(FIDUCIAL.luminosity_distance(z)) == pytest.approx(HUBBLE_DISTANCE * z, rel=1e-6)


def test_a_band_of_one_sample_and_one_at_the_edge():
    flat = 1.0 / passbands.grid() ** 2
    for at in (600.0, 5000.0, 24000.0):
        band = Passband("narrow", np.array([at]), np.array([0.3]), "vacuum")
        got = float(passbands.ab_flux(band, passbands.grid(), flat))
        assert got == pytest.approx(1.0 / units.LIGHT_ANGSTROM_S, rel=1e-6, abs=0.0)
    outside = Passband("outside", np.array([24001.0]), np.array([0.3]), "vacuum")
    with pytest.raises(BadInput, match="does not cover passband outside"):
        passbands.ab_flux(outside, passbands.grid(), flat)


@pytest.mark.parametrize("wavelength", [598.0, 24001.0, np.nan])
@pytest.mark.parametrize("kind", [0, 3])
def test_a_band_outside_the_grid_is_refused(library, kind, wavelength):
    """A negative index on the grid would give the flux at its other end."""
    outside = Passband("outside", np.array([wavelength]), np.array([0.3]), "vacuum")
    row = galaxies(kind=kind, frac_1=1.0, frac_2=0.0, ebv_1=0.0, sed_1=7, mag_r01=27.0)
    with pytest.raises(BadInput, match=r"passband outside: .* must be inside 600 to 24000 A"):
        band_fluxes.galaxy_fluxes(row, [outside], library)


def test_bands_add_up():
    # The band of two halves is their photon-weighted mean.
    whole = passbands.load("euclid_vis")
    half = len(whole.wavelength) // 2
    rng = np.random.default_rng(3)
    f_lambda = rng.uniform(0.5, 1.5, 23401)
    parts = [
        Passband("part", whole.wavelength[s], whole.response[s], "vacuum") for s in (slice(half), slice(half, None))
    ]
    total, *each = (float(passbands.ab_flux(band, passbands.grid(), f_lambda)) for band in (whole, *parts))
    width = [passbands.log_width(band) for band in parts]
    assert total == pytest.approx(np.dot(each, width) / sum(width), rel=1e-12, abs=0.0)


def test_a_redshift_outside_the_distances_is_refused():
    with pytest.raises(OutOfRange, match="z2"):
        FIDUCIAL.luminosity_distance(21.0)
