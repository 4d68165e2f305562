"""Densities of the components of the Milky Way, as published."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from truesky.catalogue.stars import milky_way as mw
from truesky.catalogue.stars.density_laws import density

JURIC, BESANCON = (mw.milky_way(model) for model in mw.MODELS)
LAWS = st.sampled_from([(galaxy.sun, c.law) for galaxy in (JURIC, BESANCON) for c in galaxy.components[:-1]])
THIN, THICK, HALO, BULGE = (component.law for component in JURIC.components)


@given(LAWS, st.floats(0.0, 1e5), st.floats(-1e5, 1e5))
def test_density_is_positive_and_finite(law, radius, height):
    sun, law = law
    value = float(density(law, sun, radius, height))
    assert np.isfinite(value)
    assert value >= 0.0


@given(LAWS, st.floats(5e3, 3e4), st.floats(0.0, 3e4), st.floats(1.0, 3.0))
def test_density_falls_outwards(law, radius, height, times):
    """Beyond the hole that the Besancon discs have in the middle."""
    sun, law = law
    here = density(law, sun, radius, height) * (1 + 1e-9)
    assert density(law, sun, radius * times, height) <= here
    assert density(law, sun, radius, height * times) <= here
    assert density(law, sun, radius, -height) <= here


@given(LAWS)
def test_density_is_one_at_the_sun(law):
    sun, law = law
    assert density(law, sun, sun.radius, sun.height) == pytest.approx(1.0)


def test_scale_heights_and_the_halo_s_slope():
    thin = density(THIN, JURIC.sun, 8000.0, [500.0, 800.0])
    assert thin[0] / thin[1] == pytest.approx(np.e)
    halo = density(HALO, JURIC.sun, [20_000.0, 40_000.0], 0.0)
    assert np.log2(halo[0] / halo[1]) == pytest.approx(2.77, abs=0.01)
    flattened = density(HALO, JURIC.sun, [30_000.0, 0.0], [0.0, 30_000.0 * 0.64])
    assert flattened[0] == pytest.approx(flattened[1])


def test_the_besancon_laws_as_they_are_printed():
    """Robin et al. 2003, Table 3, written out again without logarithms."""
    r, z = np.array([3000.0, 8500.0, 9000.0, 14_000.0]), np.array([0.0, 100.0, -390.0, 2000.0])
    sun = BESANCON.sun

    def young(r, z):
        a2 = r**2 + (z / 0.0140) ** 2
        return np.exp(-a2 / 5000**2) - np.exp(-a2 / 3000**2)

    def oldest(r, z):
        a2 = r**2 + (z / 0.0791) ** 2
        return np.exp(-np.sqrt(0.25 + a2 / 2530**2)) - np.exp(-np.sqrt(0.25 + a2 / 1320**2))

    def thick(r, z):
        inner = 1 - z**2 / 800 / (400 * (2 + 0.5))
        outer = np.exp(0.5) / (1 + 0.25) * np.exp(-np.abs(z) / 800)
        return np.exp(-(r - 8500) / 2500) * np.where(np.abs(z) <= 400, inner, outer)

    def halo(r, z):
        return np.maximum(np.hypot(r, z / 0.76), 500) ** -2.44

    for k, law in ((0, young), (6, oldest), (7, thick), (8, halo)):
        wanted = law(r, z) / law(np.array(sun.radius), np.array(sun.height))
        assert density(BESANCON.components[k].law, sun, r, z) == pytest.approx(wanted, rel=1e-9, abs=1e-300)


def test_the_thick_disc_has_no_kink():
    height = 400.0 + np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    slope = np.diff(np.log(density(BESANCON.components[7].law, BESANCON.sun, 8500.0, height)))
    assert slope == pytest.approx(slope[0], rel=0.01)


def test_the_bar():
    """sech^2 along its axes: 0.42 at one half axis; its near end is seen at positive longitudes."""
    at = [(1460.0, 0.0, np.radians(22.0)), (490.0, 0.0, np.radians(112.0)), (0.0, 390.0, 0.0)]
    for radius, height, azimuth in at:
        assert density(BULGE, JURIC.sun, radius, height, azimuth) == pytest.approx(1 / np.cosh(1.0) ** 2)
    assert density(BULGE, JURIC.sun, 0.0, 0.0) == 1.0
    assert density(BULGE, JURIC.sun, 1e5, 1e5) == pytest.approx(0.0, abs=1e-30)
    _, _, azimuth = mw.cylindrical(JURIC, 10.0, 0.0, np.array([7000.0]))
    assert azimuth > 0


def test_the_bar_s_mass():
    """Its volume, 7.1 half axes' product, times 3.8 Msun pc^-3: 1.5e10 Msun."""
    edge = np.linspace(-6000.0, 6000.0, 161)
    x, y, z = np.meshgrid(edge, edge, edge[::2], indexing="ij")
    inside = density(BULGE, JURIC.sun, np.hypot(x, y), z, np.arctan2(y, x)).sum() * 75.0**2 * 150.0
    assert 3.8 * inside == pytest.approx(1.5e10, rel=0.1)
