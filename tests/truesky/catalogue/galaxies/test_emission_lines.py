"""Emission lines: published counts of emitters, line ratios, and the matching of luminosities."""

from dataclasses import replace

import numpy as np
import pytest

from lake_schema.units import AB_CGS
from truesky.catalogue.galaxies import emission_lines, stellar_mass
from truesky.cosmology import FIDUCIAL
from truesky.fluxes import passbands
from truesky.fluxes.spectra import lines as line_list

FLUXES = np.array([5e-17, 1e-16, 2e-16, 3e-16])
PLAIN = emission_lines.model_from_table(np.array([0.0, 9.0]), np.array([0.0, 99.0]), np.zeros((2, 2)))


@pytest.mark.parametrize(
    ("near", "far", "published"),
    [
        (0.9, 1.8, (19650, 7570, 1993, 759)),
        (0.4, 1.8, (31444, 13404, 4253, 1850)),
        (0.7, 2.0, (27733, 10861, 3013, 1194)),
    ],
)
def test_expected_counts(near, far, published):
    """Pozzetti et al. 2016, model 3, per deg2; their table is rounded and integrates in coarser steps."""
    assert emission_lines.expected_counts(FLUXES, near, far) == pytest.approx(published, rel=0.025)


def test_the_matching_is_monotone():
    lines = emission_lines.model()
    for z in (0.05, 0.5, 1.3, 2.9, 5.5):
        log_l = np.linspace(38.0, 45.0, 500)
        assert np.all(np.diff(emission_lines.match_abundance(lines, np.full(500, z), log_l)) > -1e-9)


def fluxes(n, z, log_mass, rng, lines=PLAIN, log_sfr=None):
    """Draw line fluxes of galaxies on the main sequence."""
    at, mass = np.full(n, z), np.full(n, log_mass)
    rate = stellar_mass.main_sequence(stellar_mass.star_formation(), mass, at) if log_sfr is None else log_sfr
    return emission_lines.fluxes(lines, FIDUCIAL, at, mass, rate + np.zeros(n), np.zeros(n, bool), rng)


@pytest.mark.parametrize(
    ("z", "log_mass", "observed"),
    [(1.6, 9.5, 0.5), (1.6, 10.0, 0.3), (1.6, 10.5, 0.1), (2.3, 9.5, 0.63), (2.3, 10.0, 0.48), (2.3, 10.5, 0.28)],
)
def test_oxygen_over_hydrogen_by_mass(rng, z, log_mass, observed):
    """FMOS and MOSDEF, read off their figures; two scales of metallicity in one give -0.9 at 10^10 Msun."""
    found = fluxes(4000, z, log_mass, rng)
    assert np.median(np.log10(found["flux_oiii"] / found["flux_hbeta"])) == pytest.approx(observed, abs=0.2)


def test_nearby_galaxies_lie_on_the_mass_metallicity_relation():
    """The relation of Curti et al. 2020, eq. 2, at the usual star formation rates."""
    law, mass = PLAIN.metals, np.array([9.5, 10.0, 10.5])
    usual = 8.793 - 0.28 / 1.2 * np.log10(1.0 + 10.0 ** (-1.2 * (mass - 10.02)))
    rate = np.array([-0.3, 0.0, 0.3])
    assert emission_lines.metallicity(law, mass, rate, np.zeros(3)) == pytest.approx(usual, abs=0.02)
    # At a mass more star formation means less metal, and nothing leaves the calibrated range.
    found = emission_lines.metallicity(law, np.full(3, 9.5), np.array([-1.0, 0.0, 9.0]), np.zeros(3))
    assert np.all(np.diff(found) < 0)
    assert found[2] == law.limits[0]


def test_nitrogen_and_oxygen_lie_on_the_sequence_of_star_forming_galaxies(rng):
    """Kewley et al. 2013, eq. 5 at z = 0, within 0.3 dex: the locus is not what the ratios were made of."""
    for log_mass in (9.5, 10.0, 10.5):
        found = fluxes(4000, 0.05, log_mass, rng)
        n2 = np.median(np.log10(found["flux_nii"] / found["flux_halpha"]))
        o3 = np.median(np.log10(found["flux_oiii"] / found["flux_hbeta"]))
        assert o3 == pytest.approx(0.61 / (n2 + 0.08) + 1.1, abs=0.3)


def test_nitrogen_is_stronger_at_high_redshift(rng):
    """Galaxies of one mass and star formation rate: 0.092 dex per unit of redshift from z = 0.3 to 2."""
    law = replace(PLAIN, ratios=replace(PLAIN.ratios, n2_scatter=0.0), metals=replace(PLAIN.metals, scatter=0.0))
    law = replace(law, gas=replace(law.gas, scatter=0.0))
    n, rate = 50, np.full(50, 1.0)
    blue = np.zeros(n, bool)

    def ratio(z):
        found = emission_lines.fluxes(law, FIDUCIAL, np.full(n, z), np.full(n, 10.0), rate, blue, rng)
        return np.log10(found["flux_nii"] / found["flux_halpha"])

    assert ratio(1.3) - ratio(0.2) == pytest.approx(np.full(n, 0.092), abs=1e-9)
    assert ratio(4.0) == pytest.approx(ratio(2.0), abs=1e-9)


def test_hydrogen_is_case_b_behind_the_dust_of_the_gas(rng):
    """All ratios to H beta give the same A(H alpha) with Calzetti's law; it is larger for massive galaxies."""
    clear = replace(PLAIN, gas=replace(PLAIN.gas, polynomial=(0.0,), min_attenuation=0.0))
    found = fluxes(100, 1.0, 10.0, rng, clear)
    for line, ratio in PLAIN.hydrogen.items():
        assert found[f"flux_{line}"] / found["flux_hbeta"] == pytest.approx(np.full(100, ratio), rel=1e-9)
    decrements = []
    for log_mass in (9.0, 10.0, 11.0):
        found = fluxes(4000, 1.0, log_mass, rng)
        reddened = np.log10(found["flux_halpha"] / found["flux_hbeta"] / 2.86)
        assert (reddened > 0).all()
        infrared = np.log10(found["flux_pabeta"] / found["flux_hbeta"] / 0.163)
        k = {name: PLAIN.dust[f"flux_{name}"] for name in ("hbeta", "pabeta")}
        assert infrared / reddened == pytest.approx(
            np.full(4000, (k["hbeta"] - k["pabeta"]) / (k["hbeta"] - 1.0)), rel=1e-6
        )
        decrements.append(float(np.median(reddened)) / (0.4 * (k["hbeta"] - 1.0)))
    # Garn & Best 2010: 0.2, 0.91 and 1.7 mag.
    assert decrements == pytest.approx([0.34, 0.91, 1.70], abs=0.05)


def test_every_line_of_the_list_has_a_flux(rng):
    assert set(fluxes(3, 1.0, 10.0, rng)) == set(line_list.columns())


def test_every_emitter_has_its_sulphur(drawn):
    halpha, sii = (drawn.columns[f"flux_{name}"].astype(float) for name in ("halpha", "sii"))
    emits = halpha > 0
    assert (sii[emits] > 0).all()
    # Both together some third of H alpha, the column holding one of the two.
    assert 0.05 < np.median(sii[emits] / halpha[emits]) < 0.3


def test_red_galaxies_that_form_no_stars_have_no_lines(drawn):
    quiet = drawn.columns["flux_halpha"] == 0
    assert 0.001 < quiet.mean() < 0.3
    assert drawn.columns["log_sfr"][quiet].max() < -2.0


def test_flux_of_a_luminosity(rng):
    """One galaxy, no dust, no scatter, no matching: 10^41.27 SFR over the sphere."""
    plain = replace(PLAIN, gas=replace(PLAIN.gas, polynomial=(0.0,), min_attenuation=0.0))
    plain = replace(plain, halpha=replace(plain.halpha, scatter=0.0))
    flux = fluxes(1, 1.0, 10.0, rng, plain, log_sfr=1.0)["flux_halpha"]
    distance = float(FIDUCIAL.luminosity_distance(1.0)) / 0.67 * 3.0856775814913673e24
    assert flux == pytest.approx(10.0**42.27 / (4 * np.pi * distance**2), rel=1e-9, abs=0.0)


@pytest.mark.parametrize("band", ["euclid_vis", "euclid_h", "lsst_g"])
def test_added_light_is_that_of_the_spectrum(band, rng):
    n, curve = 300, passbands.load(band)
    z = rng.uniform(0.0, 2.3, n)
    fluxes = {column: 1e-16 * rng.random(n) for column in line_list.columns()}
    every = np.stack([line.ratio * fluxes[line.column] for line in line_list.line_list()], 1)
    spectra = np.zeros((n, passbands.GRID_LAST - passbands.GRID_FIRST + 1))
    line_list.add(spectra, passbands.GRID_FIRST, line_list.profiles(every, z, np.full(n, 100.0), "vacuum"))
    expected = spectra[:, curve.wavelength.astype(int) - passbands.GRID_FIRST] @ passbands.weights(curve)
    found = emission_lines.mean_line_flux(curve, z, fluxes)
    # At the edges of a band a line is narrower here than it is.
    off = np.abs(found - expected) / expected.max()
    assert np.percentile(off, 95) < 0.01
    assert off.max() < 0.25
    assert found.sum() / expected.sum() == pytest.approx(1.0, abs=0.01)


def test_magnitudes_with_no_light_and_with_doubled_light():
    flux = 10.0 ** (-0.4 * (np.array([20.0, 26.0]) + AB_CGS))
    assert emission_lines.magnitude_with_light(np.array([20.0, 26.0]), np.zeros(2)).tolist() == [20.0, 26.0]
    assert emission_lines.magnitude_with_light(np.array([20.0, 26.0]), flux) == pytest.approx(
        [20.0 - 0.7526, 26.0 - 0.7526], abs=1e-4
    )
