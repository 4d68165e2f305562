"""Spectra of supernovae: peaks, decline rates, and the normalisation of black bodies."""

import numpy as np
import pytest

from truesky.fluxes import passbands
from truesky.variability import supernova_templates
from truesky.variability.supernova_templates import KINDS, PEAK_BAND, TYPE_IA


def magnitudes(template, band):
    """Return AB magnitudes of a template in a band of its rest frame, by phase."""
    flux = passbands.ab_flux(passbands.load(band), template.wavelength, template.flux)
    with np.errstate(divide="ignore"):
        return -2.5 * np.log10(flux) - 48.6


@pytest.fixture(scope="module", params=KINDS.values(), ids=KINDS)
def template(request):
    return supernova_templates.templates()[request.param]


def test_phase_0_is_the_peak_with_magnitude_0(template):
    light = magnitudes(template, PEAK_BAND)
    assert template.phase[np.argmin(light)] == 0.0
    assert light.min() == pytest.approx(0.0, abs=1e-9)


def test_spectra_are_positive_and_in_equal_steps(template):
    assert (template.flux > 0.0).all()
    assert np.isfinite(template.flux).all()
    np.testing.assert_allclose(np.diff(template.wavelength), np.diff(template.wavelength)[0])
    np.testing.assert_allclose(np.diff(template.phase), 1.0)


def test_type_ia_supernovae_decline_as_observed():
    """Observed: B fades by 1.1 mag in 15 days, I has a second maximum, and B - V is 1 a month after the peak."""
    series = supernova_templates.templates()[TYPE_IA]
    light = {band: magnitudes(series, band) for band in ("bessell_b", "bessell_v", "bessell_i")}
    at = {band: lambda day, values=values: np.interp(day, series.phase, values) for band, values in light.items()}
    assert at["bessell_b"](15.0) == pytest.approx(1.1, abs=0.1)
    assert at["bessell_b"](30.0) - at["bessell_v"](30.0) == pytest.approx(1.0, abs=0.2)
    assert at["bessell_i"](22.0) < at["bessell_i"](15.0)


@pytest.mark.parametrize(
    ("kind", "band", "first", "last", "rate", "tolerance"),
    [
        ("Ia", "bessell_b", 100, 250, 1.4, 0.05),  # extrapolated, Lair et al. 2006
        ("II-P", "bessell_v", 20, 80, 1.2, 0.4),  # the plateau, Anderson et al. 2014
        ("II-L", "bessell_v", 20, 70, 2.8, 0.6),  # Anderson et al. 2014
        ("II-P", "bessell_r", 230, 350, 1.0, 0.1),  # the decay of 56Co
        ("Ib", "bessell_v", 60, 200, 1.75, 0.2),
    ],
)
def test_decline_rates(kind, band, first, last, rate, tolerance):
    """`rate` is in mag per 100 days."""
    series = supernova_templates.templates()[KINDS[kind]]
    light = magnitudes(series, band)
    decline = np.diff(np.interp([first, last], series.phase, light))[0] / (last - first)
    assert 100.0 * decline == pytest.approx(rate, abs=tolerance)


def test_black_bodies_of_all_temperatures_have_the_same_total_light():
    wide = np.geomspace(50.0, 1e7, 20_000)
    totals = []
    for temperature in (3000.0, 10_000.0, 30_000.0):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(supernova_templates, "_WAVELENGTH", wide)
            shape = supernova_templates._black_body(temperature)
        totals.append(np.sum(0.5 * (shape[1:] + shape[:-1]) * np.diff(wide)))
    np.testing.assert_allclose(totals, totals[0], rtol=1e-3)


def test_there_is_no_light_outside_the_phases(template):
    ends = np.array([-1e-6, 0.0, 0.5, 1.0, 1.0 + 1e-6])
    span = template.phase[-1] - template.phase[0]
    row, share = template.at_phases(template.phase[0] + ends * span)
    assert (share[[0, -1]] == 0.0).all()
    np.testing.assert_allclose(share[1:-1].sum(axis=1), 1.0)
    assert row.max() <= len(template.phase) - 2
