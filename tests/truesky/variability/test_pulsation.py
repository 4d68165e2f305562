"""Pulsating stars against published relations: periods, luminosities, amplitudes and numbers."""

import numpy as np
import pytest

from truesky.catalogue.stars import density_laws, milky_way
from truesky.randomness.per_source import PerSourceGenerator
from truesky.variability import pulsation


def draw(stars):
    return pulsation.draw(stars, PerSourceGenerator(np.arange(stars.teff.size), 1, "test"))


@pytest.fixture(scope="module")
def rr_lyrae(halo):
    stars, number = halo
    drawn = draw(stars)
    chosen = np.flatnonzero(np.isin(drawn.kind, (pulsation.RR_AB, pulsation.RR_C)))
    return stars.select(chosen), drawn.kind[chosen], drawn.period[chosen], drawn.amplitude[chosen], number


def test_period_luminosity_relation_of_rr_lyrae_stars(rr_lyrae):
    """M_H = -0.551 - 2.313 log P + 0.178 log Z (Catelan, Pritzl & Smith 2004, ApJS 154, 633, abstract).

    The luminosities are those of the isochrones, the periods those of pulsation models.
    """
    stars, kind, period, _, _ = rr_lyrae
    ab = kind == pulsation.RR_AB
    log_z = np.log10(0.0142) + stars.metallicity[ab]
    offset = stars.m_h[ab] - (-0.551 - 2.313 * np.log10(period[ab]) + 0.178 * log_z)
    assert np.mean(offset) == pytest.approx(0.0, abs=0.05)
    assert np.std(offset) < 0.04


def test_periods_of_rr_lyrae_stars(rr_lyrae):
    """Mean periods of metal-poor stars, Oosterhoff type II: 0.65 d (RRab), 0.37 d (RRc) (van Albada & Baker 1973)."""
    stars, kind, period, _, _ = rr_lyrae
    ab = kind == pulsation.RR_AB
    assert np.mean(period[ab]) == pytest.approx(0.65, abs=0.03)
    assert np.mean(period[~ab]) == pytest.approx(0.35, abs=0.04)
    assert period[ab].min() > 0.4
    assert period[ab].max() < 0.95
    assert np.all(stars.metallicity < -1.5)


def test_bailey_diagram(rr_lyrae):
    """RRab: the amplitude falls with the period; RRc have small amplitudes at short periods."""
    _, kind, period, amplitude, _ = rr_lyrae
    ab = kind == pulsation.RR_AB
    means = [
        np.mean(amplitude[ab & (period > low) & (period < low + 0.05)]) for low in (0.5, 0.55, 0.6, 0.65, 0.7, 0.75)
    ]
    assert np.all(np.diff(means) < 0.0)
    assert means[0] == pytest.approx(1.25, abs=0.1)
    assert means[-1] == pytest.approx(0.25, abs=0.15)
    assert np.mean(amplitude[~ab]) == pytest.approx(0.45, abs=0.05)
    assert pulsation.rr_lyrae_amplitude(np.array([0.55]), np.array([-1.0])) == pytest.approx(1.02, abs=0.01)


def test_number_of_rr_lyrae_stars_at_high_latitude(rr_lyrae):
    """1372 in 840 deg2 at 5 to 80 kpc (Zinn et al. 2014), around l = 290, b = 60; a fifth of them in streams.

    Sample of 300,000 giants, 2000 of which are RR Lyrae stars (2 % at 1 standard error); the tolerance is that of the
    smooth model.
    """
    _, kind, _, _, number = rr_lyrae
    galaxy = milky_way.milky_way()
    distance = milky_way.shell_distances(galaxy)
    r, z, azimuth = milky_way.cylindrical(galaxy, 290.0, 60.0, distance)
    relative = density_laws.density(galaxy.components[2].law, galaxy.sun, r, z, azimuth)
    volume = milky_way.shell_volumes(galaxy, 1.0) * ((distance > 5e3) & (distance < 8e4))
    found = kind.size * number * 1e-9 * np.sum(relative * volume)
    assert found == pytest.approx(0.8 * 1372 / 840, rel=0.15)


def test_cepheids(thin_disc):
    """Against M_H = -5.54 - 3.33 (log P - 1) (Fouque et al. 2007, A&A 476, 73).

    7 known Cepheids per kpc2 near the Sun, with a scale height of 70 pc (Groenewegen & Oudmaijer 2000), are 50 kpc^-3.
    """
    stars, number = thin_disc
    drawn = draw(stars)
    chosen = np.flatnonzero(drawn.kind == pulsation.CEPHEID)
    assert chosen.size > 100
    offset = stars.m_h[chosen] - (-5.54 - 3.33 * (np.log10(drawn.period[chosen]) - 1.0))
    assert np.mean(offset) == pytest.approx(0.0, abs=0.3)
    assert 25 < chosen.size * number < 100
    assert np.all((drawn.period[chosen] > 2.0) & (drawn.period[chosen] < 80.0))


def test_long_period_variables(thin_disc):
    """Periods follow from M_K (Whitelock et al. 2008); Miras have amplitudes of more than 2.5 mag in V."""
    stars, _ = thin_disc
    drawn = draw(stars)
    mira, weak = (np.flatnonzero(drawn.kind == kind) for kind in (pulsation.MIRA, pulsation.SEMIREGULAR))
    assert mira.size > 20
    assert weak.size > 20 * mira.size
    m_k = stars.m_h[mira] - 0.25
    assert -7.25 - 3.51 * (np.log10(drawn.period[mira]) - 2.38) == pytest.approx(m_k, abs=1e-9)
    assert drawn.amplitude[mira].min() >= 2.5
    assert np.median(drawn.amplitude[weak]) < 0.3


def test_dwarfs_and_unknown_stars_are_constant():
    n = 4
    stars = pulsation.StarProperties(
        np.array([6500.0, 6500.0, 3400.0, 6500.0]),
        np.array([4.2, np.nan, 5.0, 2.8]),
        np.array([0.8, np.nan, 0.3, np.nan]),
        np.full(n, -2.0),
        np.array([3.0, np.nan, 6.0, -0.8]),
        np.array([False, True, False, True]),
    )
    assert np.all(draw(stars).kind == pulsation.CONSTANT)
    assert pulsation.may_pulsate(stars).size == 0


def test_all_that_pulsate_are_candidates(halo):
    stars, _ = halo
    found = np.flatnonzero(draw(stars).kind != pulsation.CONSTANT)
    assert found.size > 1000
    assert np.isin(found, pulsation.may_pulsate(stars)).all()
