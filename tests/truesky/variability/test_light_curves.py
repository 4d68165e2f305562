"""Shapes of light curves: maximum at phase 0, amplitude and mean flux, and ratios of amplitudes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from truesky.fluxes import passbands
from truesky.variability import light_curves

# Range of the parameter of each shape, and largest amplitude in any band.
KINDS = {"rr_ab": (0.2, 1.5, 1.8), "rr_c": (0.2, 1.0, 1.2), "cepheid": (0.3, 1.8, 3.0), "long_period": (1.0, 3.0, 8.0)}
PHASE = np.arange(2000.0) / 2000.0


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(sorted(KINDS)), st.floats(0.0, 1.0), st.floats(0.01, 1.0))
def test_mean_flux_is_that_of_the_catalogue(kind, where, size):
    low, high, largest = KINDS[kind]
    amplitude = size * largest
    at = np.array([low + where * (high - low)])
    flux = light_curves.flux_factors(light_curves.shape(kind), at, np.array([amplitude]), PHASE[None])[0]
    assert flux.mean() == pytest.approx(1.0, abs=2e-4)
    magnitude = -2.5 * np.log10(flux)
    assert np.ptp(magnitude) == pytest.approx(amplitude, rel=0.03)
    brightest = PHASE[magnitude.argmin()]
    assert min(brightest, 1.0 - brightest) < 0.04


def test_flux_agrees_with_a_sum_of_cosines():
    """A slow reference: the series is summed directly, and its mean computed with 2000 phases."""
    curve = light_curves.shape("rr_ab")
    k = np.arange(1, light_curves.HARMONICS + 1)
    angle = 2.0 * np.pi * k[:, None] * PHASE
    for node in (0, 8, curve.node.size - 1):
        wave = (curve.cosine[node][:, None] * np.cos(angle) + curve.sine[node][:, None] * np.sin(angle)).sum(0)
        flux = 10.0 ** (-0.4 * 0.8 * wave)
        found = light_curves.flux_factors(curve, curve.node[[node]], np.array([0.8]), PHASE[None])[0]
        assert found == pytest.approx(flux / flux.mean(), rel=1e-4)


@pytest.mark.parametrize(
    ("kind", "node", "rise"), [("rr_ab", 1.1, (0.1, 0.2)), ("rr_c", 0.5, (0.35, 0.5)), ("cepheid", 0.73, (0.2, 0.33))]
)
def test_rise_is_faster_than_the_decline(kind, node, rise):
    """Fraction of a period from minimum to maximum; delta Cephei (log P = 0.73): 0.29."""
    flux = light_curves.flux_factors(light_curves.shape(kind), np.array([node]), np.array([0.8]), PHASE[None])[0]
    assert rise[0] < 1.0 - PHASE[flux.argmin()] < rise[1]


def test_amplitudes_by_wavelength():
    """RR Lyrae and Cepheids: larger in g than in V, a third of it in H; they fall with wavelength."""
    at = {name: passbands.pivot_wavelength(passbands.load(name)) for name in ("sdss_g", "bessell_v", "twomass_h")}
    for family in ("rr_lyrae", "cepheid"):
        g, v, h = (light_curves.amplitude_ratio(family, wavelength) for wavelength in at.values())
        assert 1.1 < g < 1.35
        assert v == pytest.approx(1.0, abs=0.02)
        assert 0.28 < h < 0.38
    assert light_curves.amplitude_ratio("rr_lyrae", 1500.0) == light_curves.amplitude_ratio("rr_lyrae", 3600.0)
    with pytest.raises(KeyError):
        light_curves.shape("nova")
