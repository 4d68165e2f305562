"""Quasars and galaxies beyond z = 6."""

import numpy as np
import pyarrow as pa
import pytest

from lake_schema import units
from lake_schema.errors import BadInput, OutOfRange
from truesky.cosmology import FIDUCIAL
from truesky.fluxes import band_fluxes, high_redshift, passbands
from truesky.fluxes.spectra import extinction
from truesky.request.accuracy import SURVEY

GRID = passbands.grid()
H = passbands.load("euclid_h")


@pytest.fixture
def distant(galaxies):
    """Return a function that makes rows of kind 2 or 3."""

    def make(n=6, kind=3, **columns):
        plain = {
            "kind": np.full(n, kind, np.int8), "sed_1": np.arange(n) % 9, "frac_1": 1.0, "frac_2": 0.0, "ebv_1": 0.0,
            "z_obs": np.linspace(6.0, 10.0, n), "mag_r01": 25.0, "kappa": 0.0, "gamma1": 0.0, "gamma2": 0.0, "a_v": 0.0,
        }  # fmt: skip
        return galaxies(n, **(plain | columns))

    return make


def test_libraries():
    quasars, distant = high_redshift.quasar_library(), high_redshift.high_redshift_library()
    assert (len(quasars), len(distant)) == (9, 15)
    for library in (quasars, distant):
        assert (library.flux >= 0.0).all()
        assert library.flux[:, library.wavelength > 1217.0].all()
        assert len(set(library.names)) == len(library)


@pytest.mark.parametrize("k", range(5))
def test_slopes_and_lyman_alpha(k):
    library = high_redshift.high_redshift_library()
    wavelength = library.wavelength
    plain, some, much = library.flux[3 * k : 3 * k + 3].astype(float)
    ends = plain[np.isin(wavelength, (1300.0, 2600.0))]
    assert np.log2(ends[1] / ends[0]) == pytest.approx(high_redshift.HIGH_REDSHIFT_SLOPES[k], abs=1e-4)
    level = plain[wavelength == 1216.0][0]
    assert np.sum(some - plain) / level == pytest.approx(25.0, rel=2e-3)
    assert np.sum(much - plain) / level == pytest.approx(50.0, rel=2e-3)


def test_the_continuum_of_quasars_breaks_at_5000_angstrom():
    """Slopes of Vanden Berk et al. 2001: -1.56 and 0.45 in f_lambda. Lines are twice as strong in the next template."""
    library = high_redshift.quasar_library()
    half, whole = library.flux[[3, 4]].astype(float)
    continuum = 2.0 * half - whole
    for blue, red, slope in ((1400.0, 4500.0, -1.56), (5500.0, 22_000.0, 0.45)):
        ends = continuum[np.isin(library.wavelength, (blue, red))]
        assert np.log(ends[1] / ends[0]) / np.log(red / blue) == pytest.approx(slope, abs=2e-3)


def test_quasars_have_their_lines():
    library = high_redshift.quasar_library()
    wavelength, flux = library.wavelength, library.flux.astype(float)
    near = np.abs(wavelength - 2800.0) < 140.0
    continuum = (wavelength / 5000.0) ** -1.56
    width = np.sum((flux[4] / continuum - 1.0)[near])
    assert width == pytest.approx(32.3, rel=0.05)
    twice = np.sum((flux[5] - flux[4])[near]) / np.sum((flux[4] - flux[3])[near])
    assert twice == pytest.approx(2.0, rel=1e-3)
    blue = (wavelength > 2000.0) & (wavelength < 2500.0)
    ratio = flux[7, blue] / flux[1, blue]
    assert np.polyfit(np.log(wavelength[blue]), np.log(ratio), 1)[0] == pytest.approx(0.6, abs=0.05)


@pytest.mark.parametrize(("kind", "rest"), [(2, 1450.0), (3, 1500.0)])
def test_the_magnitude_is_monochromatic_in_the_rest_frame(distant, kind, rest):
    z = np.array([6.0, 7.0, 9.0])
    f_lambda = high_redshift.spectra(distant(3, kind, z_obs=z))
    for row, redshift in zip(f_lambda, z, strict=True):
        at = rest * (1.0 + redshift)
        f_nu = np.interp(at, GRID, row) * at**2 / units.LIGHT_ANGSTROM_S
        assert float(units.mag_of_f_nu(units.ujy_of_cgs(f_nu))) == pytest.approx(25.0, abs=1e-4)


def test_nothing_is_left_below_lyman_alpha(distant):
    f_lambda = high_redshift.spectra(distant(3, z_obs=7.0))
    assert not f_lambda[:, GRID < 1215.0 * 8.0].any()
    assert (f_lambda[:, GRID > 1217.0 * 8.0] > 0.0).all()


def test_quasars_are_seen_through_the_intergalactic_medium(distant):
    """Below Lyman alpha, little light is absorbed at z = 1, a third at z = 3, and most at z = 6 (Inoue et al. 2014)."""
    z = np.array([1.0, 3.0, 6.0])
    f_lambda = high_redshift.spectra(distant(3, 2, z_obs=z, sed_1=4))
    left = []
    for row, redshift in zip(f_lambda, z, strict=True):
        rest = GRID / (1.0 + redshift)
        forest, above = (rest > 1050.0) & (rest < 1170.0), (rest > 1320.0) & (rest < 1380.0)
        continuum = np.median(row[above]) * (1216.0 / 1350.0) ** -1.56 * (1110.0 / 1216.0) ** -0.3
        left.append(np.mean(row[forest]) / continuum)
    assert left[0] > 0.85
    assert left[1] == pytest.approx(0.68, abs=0.08)
    assert left[2] < 0.1


@pytest.mark.parametrize("kind", [2, 3])
@pytest.mark.parametrize(("first", "last"), [(600, 601), (5500, 9300), (24000, 24000)])
def test_a_part_of_a_spectrum_has_the_same_numbers(distant, kind, first, last):
    rows = distant(4, kind, z_obs=np.array([0.1, 3.5, 6.0, 8.0]), a_v=0.3)
    part = high_redshift.spectra(rows, first, last)
    np.testing.assert_array_equal(part, high_redshift.spectra(rows)[:, first - 600 : last - 599])


def test_apparent_magnitude():
    # A flat f_nu keeps its magnitude at any wavelength: M + DM - 2.5 log10(1 + z), in h = 0.67.
    distance_pc = float(FIDUCIAL.luminosity_distance(7.0)) / 0.67 * 1e6
    wanted = -21.0 + 5.0 * np.log10(distance_pc / 10.0) - 2.5 * np.log10(8.0)
    assert float(high_redshift.ultraviolet_magnitude(FIDUCIAL, -21.0, 7.0)) == pytest.approx(wanted, abs=1e-9)
    assert wanted == pytest.approx(26.0, abs=0.2)


def test_lens_and_milky_way(distant):
    plain = high_redshift.fluxes(distant(), [H])
    lensed = high_redshift.fluxes(distant(kappa=0.3), [H])
    np.testing.assert_allclose(lensed, plain / 0.7**2, rtol=1e-12)
    dusty = high_redshift.fluxes(distant(a_v=1.0), [H])
    pivot = passbands.pivot_wavelength(H)
    np.testing.assert_allclose(-2.5 * np.log10(dusty / plain), float(extinction.milky_way([pivot])[0]), rtol=0.05)


def test_all_kinds_in_one_table(distant, galaxies, library):
    table = pa.concat_tables(
        [galaxies(5), distant(4, 2), galaxies(3, seed=9), distant(6, 3)], promote_options="permissive"
    )
    bands = ["euclid_h", "lsst_r"]
    whole = band_fluxes.galaxy_fluxes(table, bands, library, SURVEY)
    parts = [
        band_fluxes.galaxy_fluxes(table.slice(i, n), bands, library, SURVEY)
        for i, n in ((0, 5), (5, 4), (9, 3), (12, 6))
    ]
    assert whole.equals(pa.concat_tables(parts))
    alone = high_redshift.fluxes(table.slice(12, 6), [H])[:, 0]
    np.testing.assert_allclose(whole["f_nu_euclid_h"].to_numpy()[12:], alone, rtol=1e-6)
    # A drop-out: r is far below Lyman alpha.
    assert not whole["f_nu_lsst_r"].to_numpy()[15:].any()


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("frac_2", 0.5, "source 100 of kind 2 or 3 has a second component"),
        ("ebv_1", 0.1, "source 100 of kind 2 or 3 has internal dust"),
        ("sed_1", 15, "sed_1 = 15"),
        ("z_obs", 15.5, "z_obs = 15.5"),
        ("mag_r01", np.nan, "mag_r01 is missing in the row of source 100"),
        ("kappa", 1.0, "magnification of source 100"),
    ],
)
def test_refusals(distant, column, value, message):
    with pytest.raises(BadInput, match=message):
        high_redshift.spectra(distant(**{column: value}))
    assert issubclass(OutOfRange, BadInput)
