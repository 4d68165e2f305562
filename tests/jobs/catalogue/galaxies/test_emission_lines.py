"""Emission lines: published counts of emitters, line ratios, and the matching of luminosities."""

import numpy as np
import pytest

from jobs.catalogue.galaxies import emission_lines
from jobs.fluxes import cosmology

FLUXES = np.array([5e-17, 1e-16, 2e-16, 3e-16])


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
    for z in (0.05, 0.5, 1.3, 2.9):
        log_l = np.linspace(38.0, 45.0, 500)
        assert np.all(np.diff(emission_lines.matched(lines, np.full(500, z), log_l)) > -1e-9)


def test_lines_lie_on_the_sequence_of_star_forming_galaxies(drawn):
    """Kewley et al. 2013: below the extreme starburst line of their eq. 5 and its redshift; case B behind dust."""
    columns = {name: drawn.columns[f"flux_{name}"].astype(float) for name in emission_lines.LINES}
    bright = columns["halpha"] > 5e-17
    n2 = np.log10(columns["nii"][bright] / columns["halpha"][bright])
    o3 = np.log10(columns["oiii"][bright] / columns["hbeta"][bright])
    sequence = 0.61 / (np.minimum(n2, -0.25) + 0.08) + 1.1 + 0.03 * drawn.z[bright]
    assert np.median(o3 - np.clip(sequence, -1.0, 0.95)) == pytest.approx(0.0, abs=0.05)
    decrement = columns["halpha"][bright] / columns["hbeta"][bright]
    assert decrement.min() >= 2.859
    clean = drawn.columns["ebv_1"][bright] == 0
    assert decrement[clean] == pytest.approx(np.full(clean.sum(), 2.86), rel=1e-5)


def test_every_emitter_has_its_sulphur(drawn):
    halpha, sii = (drawn.columns[f"flux_{name}"].astype(float) for name in ("halpha", "sii"))
    emits = halpha > 0
    assert (sii[emits] > 0).all()
    # Both together some third of H alpha, the column holding one of the two.
    assert 0.05 < np.median(sii[emits] / halpha[emits]) < 0.3


def test_red_galaxies_that_form_no_stars_have_no_lines(drawn):
    quiet = drawn.columns["flux_halpha"] == 0
    assert 0.005 < quiet.mean() < 0.3
    assert drawn.columns["log_sfr"][quiet].max() < -2.0


def test_flux_of_a_luminosity():
    """One galaxy, no dust, no scatter, no matching: SFR / 7.9e-42 over the sphere."""
    from dataclasses import replace

    lines = emission_lines.unmatched(np.array([0.0, 9.0]), np.array([0.0, 99.0]), np.zeros((2, 2)))
    lines = replace(lines, halpha=replace(lines.halpha, scatter=0.0))
    rng = np.random.default_rng(1)
    one, z = np.ones(1), np.array([1.0])
    flux = emission_lines.fluxes(lines, z, 10.0 * one, one, np.array([False]), 0.0 * one, rng)["flux_halpha"]
    distance = float(cosmology.luminosity_distance(1.0)) / 0.67 * 3.0856775814913673e24
    assert flux == pytest.approx(10.0 / 7.9e-42 / (4 * np.pi * distance**2), rel=1e-9, abs=0.0)
