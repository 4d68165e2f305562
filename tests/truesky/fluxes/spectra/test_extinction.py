"""Dust laws against their published numbers."""

import numpy as np
import pytest

from lake_schema.errors import OutOfRange
from truesky.fluxes import passbands
from truesky.fluxes.spectra import extinction


def k(law: int, wavelength: float) -> float:
    return float(extinction.laws([wavelength])[law, 0])


def test_no_dust():
    assert not extinction.laws(np.geomspace(80.0, 24500.0, 100))[0].any()


@pytest.mark.parametrize(("wavelength", "ratio"), [(1275, 13.54), (3704, 1.81), (5291, 0.0), (22000, -2.47)])
def test_prevot_goes_through_its_table(wavelength, ratio):
    # R_V = 2.72 (Bouchet et al. 1985); many codes take 3.1 by mistake.
    assert k(1, wavelength) == pytest.approx(ratio + 2.72, abs=1e-12)


def test_prevot_is_extrapolated_into_the_ultraviolet():
    """The last segment is extended, linear in 1 / lambda."""
    inner = (k(1, 1275.0) - k(1, 1330.0)) / (1.0 / 1275.0 - 1.0 / 1330.0)
    outer = (k(1, 912.0) - k(1, 1275.0)) / (1.0 / 912.0 - 1.0 / 1275.0)
    assert outer == pytest.approx(inner, rel=1e-9)
    assert outer > 0.0


def test_calzetti_has_the_published_values():
    # Calzetti et al. 2000: k(V) = R_V = 4.05 at 5500 A; H alpha 3.33, H beta 4.60, [O II] 5.86.
    for wavelength, wanted in ((5500.0, 4.05), (6563.0, 3.33), (4861.0, 4.60), (3727.0, 5.86)):
        assert k(2, wavelength) == pytest.approx(wanted, abs=0.02)


def test_bumps_are_at_2175_and_leave_the_optical_alone():
    lam = np.arange(1500.0, 3000.0)
    laws = extinction.laws(lam)
    for law, height in ((3, 1.26), (4, 2.52)):
        excess = laws[law] - laws[2]
        assert lam[np.argmax(excess)] == 2175.0
        assert excess.max() == pytest.approx(height, rel=1e-12)
        assert k(law, 8000.0) - k(2, 8000.0) < 0.01 * height


def test_curves_have_no_steps_and_never_brighten():
    lam = np.arange(80.0, 24501.0)
    laws = extinction.laws(lam)
    assert (laws >= 0.0).all()
    # Published curves change by at most 0.02 per step of 1 A, at 1300 A; the two parts at 0.63 um differ by 0.03.
    for first, last, step in ((800.0, 1300.0, 0.08), (1300.0, 6200.0, 0.025), (6200.0, 24500.0, 0.035)):
        inside = (lam >= first) & (lam <= last)
        assert np.abs(np.diff(laws[:, inside])).max() < step


def test_calzetti_is_extrapolated_along_its_tangent():
    inner = (k(2, 1201.0) - k(2, 1200.0)) / 1.0
    outer = (k(2, 1200.0) - k(2, 1000.0)) / 200.0
    assert outer == pytest.approx(inner, rel=2e-3)


def test_milky_way_is_normalised_at_v():
    lam = np.arange(5000.0, 6000.0)
    a_ratio = extinction.milky_way(lam)
    assert abs(lam[np.argmin(np.abs(a_ratio - 1.0))] - 5500.0) <= 60.0
    # The printed A = E(B-V) R_V, without the curve, would be 1 everywhere.
    far = extinction.milky_way([1500.0, 3000.0, 10000.0, 20000.0])
    np.testing.assert_allclose(far, [2.65, 1.80, 0.40, 0.13], atol=0.08)


def test_milky_way_reaches_over_the_whole_grid():
    a_ratio = extinction.milky_way(passbands.grid())
    assert np.isfinite(a_ratio).all()
    assert (a_ratio > 0.0).all()
    assert a_ratio[0] == a_ratio[399]


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("euclid_vis", 2.27),
        ("euclid_y", 1.12),
        ("euclid_j", 0.776),
        ("euclid_h", 0.510),
        ("lsst_u", 4.72),
        ("lsst_g", 3.75),
        ("lsst_r", 2.70),
        ("lsst_i", 2.10),
        ("lsst_z", 1.61),
    ],
)
def test_band_coefficients_of_the_milky_way(name, wanted):
    """Compare A / E(B-V) for a source with flat f_nu."""
    assert dimming(name, 0.05) / 0.05 == pytest.approx(wanted, rel=0.02)


def dimming(name: str, ebv: float) -> float:
    band = passbands.load(name)
    flux = band.wavelength**-2.0
    dust = extinction.transmission(3.1 * extinction.milky_way(band.wavelength), ebv)
    weights = passbands.weights(band)
    return float(-2.5 * np.log10((weights @ (flux * dust)) / (weights @ flux)))


def test_scaling_a_bands_extinction_linearly_would_be_wrong():
    # Serrano et al. 2024 scale from E(B-V) = 0.2; the code integrates at each E(B-V).
    assert abs(dimming("euclid_vis", 0.5) - 2.5 * dimming("euclid_vis", 0.2)) > 0.01
    assert abs(dimming("euclid_h", 0.5) - 2.5 * dimming("euclid_h", 0.2)) < 0.002


@pytest.mark.parametrize(("first", "count"), [(600, 23401), (3000, 8742), (23999, 2)])
def test_the_table_of_the_milky_way_contains_the_law(first, count):
    np.testing.assert_array_equal(
        extinction.milky_way_table(first, count), extinction.milky_way(first + np.arange(float(count)))
    )


@pytest.mark.parametrize(("first", "count"), [(599, 2), (23990, 12), (24001, 1)])
def test_the_table_of_the_milky_way_ends(first, count):
    with pytest.raises(OutOfRange, match="wavelength"):
        extinction.milky_way_table(first, count)


def test_transmission_keeps_single_precision():
    curve = np.ones((2, 3), np.float32)
    out = extinction.transmission(curve, np.array([[1.0], [2.0]], np.float32))
    assert out.dtype == np.float32
    np.testing.assert_allclose(out[:, 0], [10**-0.4, 10**-0.8], rtol=1e-6)
