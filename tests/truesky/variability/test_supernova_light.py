"""Fluxes and spectra of supernovae: compared with sncosmo, with direct integrals, and at the ends of their ranges."""

import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from truesky.fluxes import passbands
from truesky.variability import supernova_light, supernova_templates
from truesky.variability.supernova_light import Supernovae
from truesky.variability.supernova_templates import TYPE_IA, Template

TEMPLATES = supernova_templates.templates()
REFERENCES = Path(__file__).with_name("supernova_references.csv")


def one(kind=TYPE_IA, z=0.5, peak=60000.0, magnitude=22.0, stretch=1.0, ebv=0.0, magnification=1.0, a_v=0.0):
    """Return a single supernova."""
    numbers = (np.array([value]) for value in (z, peak, magnitude, stretch, ebv, magnification, a_v))
    return Supernovae(np.array([kind]), *numbers)


def flux(supernova, band, mjd):
    return supernova_light.fluxes(supernova, passbands.load(band), np.atleast_2d(mjd), TEMPLATES)


def test_magnitudes_agree_with_sncosmo():
    """Sample: 100 supernovae of redshift 0.02 to 1.2 in five bands (scripts/supernova_references.py)."""
    with REFERENCES.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    difference = []
    for row in rows:
        names = ("z", "peak_mjd", "magnitude", "stretch", "ebv", "a_v")
        z, peak, magnitude, stretch, ebv, a_v = (float(row[name]) for name in names)
        supernova = one(TYPE_IA, z, peak, magnitude, stretch, ebv, 1.0, a_v)
        difference.append(
            23.9 - 2.5 * np.log10(flux(supernova, row["band"], float(row["mjd"]))[0, 0]) - float(row["mag"])
        )
    assert len(difference) == 100
    assert np.abs(difference).max() < 0.01
    assert abs(np.mean(difference)) < 0.001


@given(
    st.sampled_from(sorted(TEMPLATES)), st.floats(0.0, 3.0), st.floats(-300.0, 900.0), st.floats(0.7, 1.2),
    st.floats(-0.3, 1.5), st.sampled_from(["lsst_u", "euclid_vis", "euclid_h"]),
)  # fmt: skip
def test_a_flux_is_the_integral_of_the_spectrum(kind, z, age, stretch, ebv, name):
    supernova, band = one(kind, z, stretch=stretch, ebv=ebv, a_v=0.3), passbands.load(name)
    mjd = 60000.0 + age
    spectrum = supernova_light.spectra(supernova, band.wavelength, mjd, TEMPLATES)
    expected = passbands.ab_flux(band, band.wavelength, spectrum) * 1e29
    np.testing.assert_allclose(flux(supernova, name, mjd)[0], expected, rtol=1e-9, atol=1e-300)


def random_supernovae(n, seed):
    rng = np.random.default_rng(seed)
    return Supernovae(
        rng.choice(sorted(TEMPLATES), n), rng.uniform(0.0, 6.0, n), 60000.0 + rng.uniform(-300.0, 100.0, n),
        rng.uniform(18.0, 26.0, n), rng.uniform(0.7, 1.2, n), rng.uniform(-0.3, 1.5, n), rng.uniform(1.0, 9.0, n),
        np.zeros(n),
    )  # fmt: skip


@given(
    st.integers(2, 20), st.floats(0.3, 500.0), st.floats(2000.0, 7000.0), st.integers(0, 19), st.floats(0.0, 1.0),
    st.floats(-0.5, 0.5),
)  # fmt: skip
def test_no_flux_exceeds_its_upper_limit_with_any_template(count, step, first, spike, z, ebv):
    """The spectrum has light at one point only, anywhere in a block and in the band, or outside of it."""
    flux = np.zeros((2, count))
    flux[:, spike % count] = 1.0
    own = {TYPE_IA: Template(np.array([-1.0, 1.0]), first + step * np.arange(count), flux)}
    band, supernova = passbands.load("lsst2016_r"), one(z=z, ebv=ebv)
    f_nu = supernova_light.fluxes(supernova, band, np.array([[60000.0]]), own)[0, 0]
    limit = supernova_light.upper_limits(supernova, band, 60000.0, own)[0]
    assert limit >= f_nu * (1.0 - 1e-9)
    spectrum = supernova_light.spectra(supernova, band.wavelength, 60000.0, own)
    expected = passbands.ab_flux(band, band.wavelength, spectrum)[0] * 1e29
    assert f_nu == pytest.approx(expected, rel=1e-9, abs=1e-12 * float(spectrum.max()) * 1e29)


@pytest.mark.parametrize(("first", "last"), [(5900, 6000), (5901, 6000), (5900, 6001), (5950, 5950), (900, 1000)])
def test_points_of_the_template_on_the_ends_of_the_band(first, last):
    at = np.arange(first, last + 1.0)
    band = passbands.Passband("top hat", at, np.ones(len(at)), "vacuum")
    for kind in (TYPE_IA, 2):
        supernova = one(kind, z=0.0)
        spectrum = supernova_light.spectra(supernova, at, 60000.0, TEMPLATES)[0]
        expected = float(np.sum(passbands.weights(band) * spectrum)) * 1e29
        found = supernova_light.fluxes(supernova, band, np.array([[60000.0]]), TEMPLATES)[0, 0]
        assert found == pytest.approx(expected, rel=1e-9, abs=0.0)


def test_blocks_of_points_do_not_change_light_curves(monkeypatch):
    several, band = random_supernovae(30, 6), passbands.load("lsst_i")
    dates = np.linspace(59900.0, 60400.0, 50)[None]
    expected = supernova_light.fluxes(several, band, dates, TEMPLATES)
    monkeypatch.setattr(supernova_light, "_POINTS", 100)
    np.testing.assert_array_equal(supernova_light.fluxes(several, band, dates, TEMPLATES), expected)


@pytest.mark.parametrize("name", ["lsst_u", "euclid_vis", "euclid_h"])
def test_no_flux_exceeds_its_upper_limit(name):
    band, several = passbands.load(name), random_supernovae(600, 5)
    f_nu = supernova_light.fluxes(several, band, np.array([[60000.0]]), TEMPLATES)[:, 0]
    limits = supernova_light.upper_limits(several, band, 60000.0, TEMPLATES)
    assert (f_nu > 0.0).sum() > 300
    assert (limits >= f_nu * (1.0 - 1e-12)).all()
    # The limit is useful: for half of the supernovae in H, it is less than 0.5 mag above the flux.
    if name == "euclid_h":
        assert np.median(limits[f_nu > 0.0] / f_nu[f_nu > 0.0]) < 1.6


def test_a_flux_does_not_depend_on_other_dates_and_supernovae():
    rng, n = np.random.default_rng(3), 40
    kinds = rng.choice(sorted(TEMPLATES), n)
    several = Supernovae(kinds, rng.uniform(0.01, 2.0, n), rng.uniform(59900.0, 60100.0, n), rng.uniform(18.0, 26.0, n),
                         rng.uniform(0.8, 1.1, n), rng.uniform(-0.1, 0.3, n), np.ones(n), np.full(n, 0.1))  # fmt: skip
    dates = np.sort(rng.uniform(59800.0, 60500.0, 30))
    together = flux(several, "lsst_i", dates)
    for i in (0, 17, 39):
        alone = flux(several.select(np.array([i])), "lsst_i", dates[7])
        assert alone[0, 0] == together[i, 7]


def test_the_light_at_the_peak_has_the_magnitude_of_the_row():
    """At z = 0, the apparent B magnitude at the peak is the magnitude of the row, also with a colour."""
    for ebv in (-0.2, 0.0, 0.4):
        light = flux(one(z=0.0, ebv=ebv), supernova_templates.PEAK_BAND, 60000.0)[0, 0]
        assert 23.9 - 2.5 * np.log10(light) == pytest.approx(22.0, abs=0.02)


def test_redshift_stretch_and_magnification():
    near, far = one(z=0.0), one(z=1.0, stretch=1.2, magnification=3.0)
    first, last = supernova_light.first_and_last_day(far, TEMPLATES)
    edges = TEMPLATES[TYPE_IA].phase[[0, -1]]
    np.testing.assert_allclose([first[0], last[0]], 60000.0 + 2.4 * edges)
    rest, seen = np.array([4000.0, 5000.0]), np.array([8000.0, 10_000.0])
    at_rest = [supernova_light.spectra(near, np.arange(w, w + 1.0), 60010.0, TEMPLATES)[0, 0] for w in rest]
    observed = [supernova_light.spectra(far, np.arange(w, w + 1.0), 60024.0, TEMPLATES)[0, 0] for w in seen]
    np.testing.assert_allclose(observed, np.array(at_rest) * 3.0 / 2.0, rtol=1e-12)


def test_ends_of_the_ranges():
    supernova = one(z=6.0, magnitude=40.0)
    first, last = supernova_light.first_and_last_day(supernova, TEMPLATES)
    dates = np.array([first[0] - 1e-3, first[0], last[0], last[0] + 1e-3, -1e5, 3e5])
    light = flux(supernova, "euclid_h", dates)[0]
    assert (light[[0, 3, 4, 5]] == 0.0).all()
    assert (light[1:3] > 0.0).all()
    # Wavelengths below the first of the template have no light.
    assert flux(one(z=6.0), "bessell_u", 60000.0)[0, 0] == 0.0
    assert flux(one().select(np.zeros(0, int)), "lsst_r", 60000.0).shape == (0, 1)
