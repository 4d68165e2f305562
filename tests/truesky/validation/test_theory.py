"""Correlations of theory against relations that hold for any power spectrum."""

import csv
from pathlib import Path

import numpy as np
import pytest
from scipy.special import j0, jv

from truesky.cosmology import FIDUCIAL, LIMITS, Cosmology
from truesky.validation import theory

ARCMIN = np.radians(1 / 60)


def test_the_aperture_mass_of_waves():
    """A single multipole gives 24 J4(x) / x^2 squared and no B mode (Schneider et al. 1998)."""
    edges, radius = np.linspace(0.0, 20.0, 4001), 10.0
    theta = 0.5 * (edges[1:] + edges[:-1])
    for ell in (0.2, 0.5, 1.0):
        mass, cross = theory.aperture_mass(edges, j0(ell * theta), jv(4, ell * theta), radius)
        wanted = (24.0 * jv(4, ell * radius) / (ell * radius) ** 2) ** 2
        assert mass == pytest.approx(wanted, rel=1e-3, abs=1e-6)
        assert cross == pytest.approx(0.0, abs=2e-5)
        mass, cross = theory.aperture_mass(edges, j0(ell * theta), -jv(4, ell * theta), radius)
        assert cross == pytest.approx(wanted, rel=1e-3, abs=1e-6)


def test_bessel_s_function_is_that_of_scipy():
    x = np.geomspace(1e-4, 1e4, 3000)
    assert theory._j4(x) == pytest.approx(jv(4, x), rel=1e-6, abs=1e-11)


def test_a_power_law_has_the_correlation_that_it_must():
    """C_l = l^-1.2: w = theta^-0.8 2^-0.2 Gamma(0.4) / (2 pi Gamma(0.6))."""
    from math import gamma

    theta = np.array([1.0, 3.0, 10.0]) * ARCMIN
    ell = np.geomspace(1e-2, 2e5, 2000)
    wanted = theta**-0.8 * 2**-0.2 * gamma(0.4) / (2 * np.pi * gamma(0.6))
    assert theory.correlation(theta, ell, ell**-1.2) == pytest.approx(wanted, rel=0.01)


def test_power_is_linear_where_structure_is():
    """Within halos it is at least eight times the linear power, according to the published fit."""
    k = np.array([0.01, 0.02, 5.0])
    ratio = theory.matter_power(FIDUCIAL, k, 0.5) / theory.matter_power(FIDUCIAL, k, 0.5, is_linear=True)
    assert ratio[:2] == pytest.approx(np.ones(2), abs=0.03)
    assert 8.0 < ratio[2] < 40.0


def test_halofit_is_that_of_camb(monkeypatch):
    """The linear power today is that of the shipped table, which dark energy changes little at fixed sigma_8.

    Dark energy far from a constant changes it by 1 % at 0.01 h/Mpc.
    """
    today = theory._linear_power_today(FIDUCIAL)
    monkeypatch.setattr(theory, "_linear_power_today", lambda cosmology: today)
    path = Path(__file__).parents[1] / "cosmology_references.csv"
    values = {}
    for row in csv.DictReader(path.read_text().splitlines()):
        if row["quantity"].startswith("halofit_z"):
            cosmology = Cosmology(**{name: float(row[name]) for name in LIMITS})
            z, k, expected = float(row["quantity"].removeprefix("halofit_z")), float(row["at"]), float(row["value"])
            if k == 0.01 and cosmology.w0 == -0.6:
                continue
            value = float(theory.matter_power(cosmology, np.array([k]), z)[0])
            assert value == pytest.approx(expected, rel=2.5e-3, abs=0.0), row
            values[cosmology.w0, z, k] = value
    assert len(values) == 56
    # Dark energy with w > -1 adds power within halos, also at equal linear power.
    assert 1.01 < values[-0.9, 0.0, 1.0] / values[-1.0, 0.0, 1.0] < 1.02


def test_sources_at_two_distances_are_between_those_at_each():
    chi, ell = np.asarray(FIDUCIAL.comoving_distance(np.array([0.8, 1.2]))), np.array([100.0, 1000.0])
    near, far, both = (
        theory.convergence_power(FIDUCIAL, ell, chi, np.array(weight))
        for weight in ((1.0, 1e-9), (1e-9, 1.0), (1.0, 1.0))
    )
    assert np.all((near < both) & (both < far))
    # Both sources share matter, so the cross power is at least the geometric mean.
    assert np.all(both > np.sqrt(near * far) * 0.9)


def test_galaxies_of_twice_the_bias_cluster_four_times_as_much():
    chi, edges, ell = np.array([1510.0, 1620.0, 1690.0]), np.array([1500.0, 1600.0, 1700.0]), np.array([300.0])
    one, two = (theory.galaxy_power(FIDUCIAL, ell, theory.shells(chi, np.full(3, bias), edges)) for bias in (1.0, 2.0))
    assert two == pytest.approx(4 * one, rel=1e-12, abs=0.0)
