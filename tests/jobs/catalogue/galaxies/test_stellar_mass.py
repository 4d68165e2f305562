"""Stellar masses and star-formation rates from light and colour."""

import numpy as np
import pytest

from jobs.catalogue.galaxies import band_ratios, stellar_mass
from jobs.fluxes import passbands
from jobs.fluxes.libraries.templates import Library
from jobs.fluxes.spectra import extinction

TEN_PC_CM = 3.0856775814913673e19


def two(template, law=0, ebv=0.0, share=0.0):
    one = np.ones(1)
    integer = one.astype(int)
    return band_ratios.Sed(
        template * integer, (1 - share) * one, (template - 1) * integer, share * one, law * integer, ebv * one
    )


def test_a_solar_galaxy():
    """Bell et al. 2003: log M/L_r = -0.306 + 1.097 (g - r), at the Sun's M_r = 4.76 and g - r = 0.5."""
    law = stellar_mass.mass_to_light()
    m_r = 4.76 - 5 * np.log10(0.67)
    log_mass = stellar_mass.log_stellar_mass(law, np.array([m_r]), np.array([0.5 + 0.16]))
    assert log_mass == pytest.approx(-0.306 + 1.097 * 0.5 - 0.15, abs=1e-12)


def test_mass_follows_light_and_colour():
    law = stellar_mass.mass_to_light()
    faint, bright = stellar_mass.log_stellar_mass(law, np.array([-20.0, -22.5]), np.array([0.6, 0.6]))
    assert bright - faint == pytest.approx(1.0)
    blue, red = stellar_mass.log_stellar_mass(law, np.array([-20.0, -20.0]), np.array([0.3, 0.9]))
    assert red - blue == pytest.approx(1.097 * 0.6)


def test_star_formation_of_a_flat_spectrum():
    """Constant f_nu: the ultraviolet L_nu is that of M_r itself (Kennicutt 1998, eq. 1, less 0.30 dex)."""
    wavelength = np.arange(80.0, 24501.0)
    flat = Library(wavelength, np.tile((5500.0 / wavelength) ** 2, (2, 1)).astype(np.float32), ("a", "b"))
    light = stellar_mass.light(flat, np.array([0.0, 0.25, 0.5]))
    l_nu = 4 * np.pi * TEN_PC_CM**2 * 10 ** (-0.4 * (-20.0 + 5 * np.log10(0.67) + 48.6))
    got = stellar_mass.log_sfr(light, np.array([-20.0]), two(1, share=0.3))
    assert got == pytest.approx(np.log10(1.4e-28 * l_nu) - 0.30, abs=2e-3)


@pytest.mark.parametrize("law", [1, 2, 3, 4])
def test_internal_dust_is_undone(library, law):
    """A galaxy forms as many stars behind dust as without it: M_r grows by the dust's own A(0.1r)."""
    light = stellar_mass.light(library, band_ratios.load(library, "euclid_vis", 2.3, 0.5).ebv)
    rest, ebv, template = passbands.load("sdss_r01"), 0.31, 24
    spectrum = library.flux[template].astype(float)
    dusty = spectrum * 10.0 ** (-0.4 * extinction.laws(library.wavelength)[law] * ebv)
    dimmed = -2.5 * np.log10(
        passbands.ab_flux(rest, library.wavelength, dusty) / passbands.ab_flux(rest, library.wavelength, spectrum)
    )
    bare = stellar_mass.log_sfr(light, np.array([-20.0]), two(template))
    behind = stellar_mass.log_sfr(light, np.array([-20.0 + dimmed]), two(template, law, ebv))
    assert behind == pytest.approx(bare, abs=1e-4)


def test_later_templates_form_more_stars_at_a_luminosity(library):
    light = stellar_mass.light(library, np.array([0.0, 0.25, 0.5]))
    rates = [stellar_mass.log_sfr(light, np.array([-20.0]), two(t))[0] for t in range(1, 31)]
    assert np.all(np.diff(rates) > 0)
    assert rates[-1] - rates[0] > 2.0
