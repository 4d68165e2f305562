"""Compare intergalactic absorption with published formulas and observations, and between all ways to compute fluxes."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests import requests
from truesky.fluxes import band_fluxes, inputs, integration, passbands, sources
from truesky.fluxes.spectra import intergalactic
from truesky.fluxes.tables import build_tables, errors_measured, flux_tables, settings
from truesky.fluxes.tables.build_tables import Setting
from truesky.request.accuracy import SURVEY
from truesky.request.from_toml import from_table


def test_the_forest_has_the_observed_opacity():
    """Becker et al. 2013, MNRAS 430, 2067, eq. 5: effective depth of the Lyman alpha forest at 2.2 < z < 3."""
    for z in (2.2, 2.5, 3.0):
        observed = 0.751 * ((1.0 + z) / 4.5) ** 2.90 - 0.132
        # Just below the line: clouds at the redshift of the source.
        at = 1215.67 * (1.0 + z) - 1.0
        found = -np.log(intergalactic.transmission([at], [z])[0, 0])
        assert found == pytest.approx(observed, abs=0.05)


def published(z, x):
    """Inoue et al. 2014, eqs. 25, 26, 28 and 29, as printed, for z < 4.7; x = observed wavelength / 911.8 A."""
    s, clear = 1.0 + z, x**-0.3
    if z < 1.2:
        forest = 0.3248 * (x**1.2 - s**-0.9 * x**2.1)
    elif x < 2.2:
        forest = 0.02545 * s**1.6 * x**2.1 + 0.3248 * x**1.2 - 0.2496 * x**2.1
    else:
        forest = 0.02545 * (s**1.6 * x**2.1 - x**3.7)
    if z < 2.0:
        return forest + 0.2113 * s**2 - 0.07661 * s**2.3 * clear - 0.1347 * x**2
    more = 0.04696 * s**3 - 0.01779 * s**3.3 * clear
    return forest + more + (0.634 - 0.1347 * x**2 - 0.2905 * clear if x < 3.0 else -0.02916 * x**3)


@pytest.mark.parametrize(("z", "x"), [(1.0, 1.5), (1.6, 2.3), (1.6, 1.2), (2.8, 3.4), (2.8, 2.5), (2.8, 2.0)])
def test_the_continuum_is_the_published_one(z, x):
    found = intergalactic._continuum_depth(np.array([x * intergalactic.LYMAN_LIMIT]), np.array([1.0 + z]))[0, 0]
    assert found == pytest.approx(published(z, x), rel=2e-3, abs=1e-3)


@given(st.floats(0.0, 20.0), st.floats(0.0, 0.2), st.floats(0.1, 24000.0))
def test_more_clouds_transmit_less(z, further, wavelength):
    """At a fixed wavelength, transmission decreases with the redshift of the source; redward of Lyman alpha it is 1."""
    near, far = intergalactic.transmission([wavelength], [z, z + further])[:, 0]
    assert 0.0 <= far <= near * (1.0 + 1e-12)
    assert near <= 1.0
    assert near == 1.0 or wavelength < 1215.67 * (1.0 + z) + 0.5


def test_series_of_lines():
    wavelength, forest, damped = (np.array(column) for column in intergalactic.lyman_series())
    assert wavelength.size == 39
    # Rydberg: 1 / (1 - 1 / n^2) of the limit.
    n = np.arange(2, 41)
    assert wavelength == pytest.approx(911.753 / (1.0 - 1.0 / n**2), rel=2e-5)
    assert np.all(np.diff(np.log(forest)) < 0)
    assert np.all(np.diff(np.log(damped)) < 0)


def test_transmission_is_continuous_in_redshift():
    """A line edge is distributed over the bins that it crosses."""
    band = passbands.load("lsst_u")
    z = np.linspace(2.0, 2.002, 41)
    seen = intergalactic.transmission(band.wavelength, z) @ passbands.weights(band)
    assert np.abs(np.diff(seen, 2)).max() < 2e-5 * seen[0]


def test_only_blue_bands_of_distant_galaxies_are_dimmed(galaxies, library):
    """Tables, integration and whole spectra agree. Without the option in the request, fluxes are unchanged."""
    behind = replace(library, intergalactic=True)
    table = galaxies(60, z_obs=np.linspace(0.05, 2.95, 60))
    names = ("gaia_bp", "lsst_u", "lsst_g", "lsst_r")
    bands = [passbands.load(name) for name in names]
    rows, z = sources.galaxies_from_table(table, library), np.linspace(0.05, 2.95, 60)
    clear, dimmed = (integration.galaxy_fluxes(rows, bands, each) for each in (library, behind))
    for k, band in enumerate(bands):
        far = z > band.wavelength[0] / 1215.67 - 1.0
        assert np.array_equal(dimmed[~far, k], clear[~far, k])
        assert np.all(dimmed[far, k] <= clear[far, k])
    u = names.index("lsst_u")
    lost = 2.5 * np.log10(clear[:, u] / dimmed[:, u])
    assert 0.02 < np.interp(2.0, z, lost) < 0.2
    assert 0.2 < np.interp(2.9, z, lost) < 1.0
    whole = band_fluxes.band_fluxes(band_fluxes.galaxy_spectra(table, behind, bands[u].medium), [bands[u]])[:, 0]
    assert dimmed[:, u] == pytest.approx(whole, rel=1e-5)


def differing(band, setting, behind, seed):
    """Return the largest error of tables relative to integration."""
    rows = errors_measured.draw_galaxies(400, len(behind), np.random.default_rng(seed))
    fast = flux_tables.galaxy_fluxes(rows, flux_tables.open_grid([band], [setting], behind))
    return np.abs(fast / integration.galaxy_fluxes(rows, [band], behind) - 1.0).max()


def test_tables_include_intergalactic_absorption(library):
    g, behind = passbands.load("lsst_g"), replace(library, intergalactic=True)
    assert differing(g, Setting(0.007, 6, 3), behind, 8) < 3e-4
    assert build_tables.library_key(behind) != build_tables.library_key(library)


def test_a_request_enables_intergalactic_absorption():
    """The option is passed from the request to the library of the workers."""
    wanted = from_table(tomllib.loads(requests.text("[fluxes]\nintergalactic = true\n")))
    assert inputs.read(wanted.curves).library.intergalactic
    assert inputs.galaxy_library_from_facts(Path(), {"intergalactic": True}).intergalactic
    assert not inputs.galaxy_library_from_facts(Path(), {}).intergalactic


@pytest.mark.nightly
def test_table_errors_are_measured_with_absorption(library):
    """Settings measured without absorption are not used; the selected setting has the requested accuracy."""
    behind = replace(library, intergalactic=True)
    u, i = passbands.load("lsst_u"), passbands.load("des_i")
    found = errors_measured.choose([u, i], SURVEY, behind)
    assert found[1] == settings.choose(["des_i"], SURVEY)[0]
    assert settings.MARGIN * found[0].largest <= SURVEY.flux
    assert differing(u, found[0].setting, behind, 9) < SURVEY.flux


@pytest.mark.parametrize("z", [0.0, 0.5, 2.0, 6.4])
def test_absorption_never_brightens(z):
    """This includes wavelengths at which the published approximation gives negative depths."""
    passed = intergalactic.transmission(np.arange(1.0, 10_000.0), [z])
    assert (passed <= 1.0).all()
    assert (passed >= 0.0).all()
