"""Tests of narrow lines of active nuclei."""

import numpy as np
import pytest

from truesky.catalogue.galaxies import emission_lines
from truesky.catalogue.nuclei import narrow_lines
from truesky.catalogue.nuclei.accretion import Nuclei
from truesky.catalogue.nuclei.narrow_lines import LineTables
from truesky.cosmology import FIDUCIAL
from truesky.randomness.per_source import PerSourceGenerator

LAW, LINES = narrow_lines.laws(), emission_lines.model()
TABLES = LineTables(LINES.hydrogen, LINES.dust)


def above_kewley(flux):
    """Return True above the line of Kewley et al. 2001, eq. 5 (ApJ 556, 121)."""
    n2, r3 = np.log10(flux["flux_nii"] / flux["flux_halpha"]), np.log10(flux["flux_oiii"] / flux["flux_hbeta"])
    return (n2 >= 0.47) | (r3 > 0.61 / (np.minimum(n2, 0.469) - 0.47) + 1.19)


def drawn(log_rate, n=2000, nucleus_type=2, log_mass=10.7):
    nuclei = Nuclei(np.full(n, nucleus_type), np.full(n, log_rate), np.full(n, 44.0))
    rng = PerSourceGenerator(np.arange(n), 1, "test")
    return narrow_lines.fluxes(LAW, TABLES, FIDUCIAL, nuclei, np.full(n, 0.1), np.full(n, log_mass), rng)


@pytest.mark.parametrize("log_rate", [-4.5, -3.0, -1.0])
def test_pure_nuclei_are_above_the_line_of_kewley(log_rate):
    """Sample: 2,000 nuclei. Significance: 95 % are above the line, 20 standard deviations of a share of 80 %."""
    assert above_kewley(drawn(log_rate)).mean() > 0.95


def test_seyferts_have_more_oiii_than_liners():
    """Kewley et al. 2006: the two branches are 0.3 dex or more apart. Sample: 2,000 each; errors of 0.003 dex."""
    r3 = [np.log10(flux["flux_oiii"] / flux["flux_hbeta"]).mean() for flux in (drawn(-4.5), drawn(-1.0))]
    assert r3[1] - r3[0] > 0.3


def test_oiii_follows_the_bolometric_luminosity():
    """Lamastra et al. 2009: L_bol / L_[O III] = 87, 142 and 454 at 10^39, 10^41 and 10^43 erg/s."""
    log_oiii, ratio = np.array([39.0, 41.0, 43.0]), np.array([87.0, 142.0, 454.0])
    assert narrow_lines.log_oiii(LAW, log_oiii + np.log10(ratio)) == pytest.approx(log_oiii, abs=1e-3)
    steps = np.diff(narrow_lines.log_oiii(LAW, np.linspace(40.0, 47.0, 200)))
    assert (steps > 0.0).all()


def test_flux_and_dust_of_oiii():
    """The luminosity, dimmed by dust, over 4 pi d^2. Sample: 2,000 with a scatter of 0.38 dex; 4 errors of a median."""
    distance = FIDUCIAL.luminosity_distance(0.1) / FIDUCIAL.h * 3.0857e24
    expected = narrow_lines.log_oiii(LAW, np.array([44.0])) - 0.4 * LAW.a_halpha * LINES.dust["flux_oiii"]
    expected -= np.log10(4.0 * np.pi) + 2.0 * np.log10(distance)
    found = np.median(np.log10(drawn(-2.0)["flux_oiii"]))
    assert found == pytest.approx(float(expected[0]), abs=4.0 * 1.25 * 0.38 / np.sqrt(2000))


def test_galaxies_without_a_nucleus_have_no_narrow_lines():
    assert all((flux == 0.0).all() for flux in drawn(-2.0, 5, nucleus_type=0).values())
    assert set(drawn(-2.0, 5)) == set(LINES.dust)
