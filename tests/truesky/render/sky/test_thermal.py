"""Thermal light follows Planck's law by astropy, and a warmer telescope increases the light in a band."""

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling.physical_models import BlackBody

from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import resolve
from truesky.fluxes import passbands
from truesky.fluxes.passbands import Passband
from truesky.render.sky import thermal

MISSION = resolve()
H = passbands.load("euclid_h")


@pytest.mark.parametrize("temperature", [130.0, 250.0, 320.0])
def test_photons_are_planck_s(temperature):
    wavelength = H.wavelength * u.AA
    radiance = BlackBody(temperature * u.K, scale=1.0 * u.erg / (u.s * u.cm**2 * u.AA * u.sr))(wavelength)
    photons = (radiance / wavelength.to(u.erg, u.spectral()) * u.ph).to(u.ph / (u.s * u.AA**3 * u.sr)).value
    theirs = np.trapezoid(photons * H.response, H.wavelength)
    assert np.exp(thermal.brightness(H, temperature)) == pytest.approx(theirs, rel=1e-5, abs=0.0)


def test_any_temperature_has_a_logarithm():
    blue = Passband("blue", np.arange(5000.0, 5100.0), np.ones(100), "vacuum")
    # Wien: exp(-h c / (lambda k T)).
    found = thermal.brightness(blue, 20.0) - thermal.brightness(blue, 40.0)
    assert found == pytest.approx(-1.438776877e8 / 5099 * (1 / 20 - 1 / 40), rel=1e-3)
    with pytest.raises(OutOfRange, match="temperature"):
        thermal.brightness(blue, 0.0)


def test_the_level_is_the_mission_s():
    for name, level in (("euclid_y", 0.0), ("euclid_j", 0.001), ("euclid_h", 0.02)):
        assert thermal.rate("nisp", name, passbands.load(name), MISSION) == pytest.approx(level)


@pytest.mark.parametrize("body", ["telescope", "instrument"])
def test_a_warmer_body_shines_more_by_its_part(body):
    """Each body gives half of the light. At the red end of H, 2.02 um, Wien's law gives its growth."""
    key = f"nisp.thermal.{body}_temperature"
    before = MISSION.value(key, "K")
    for warmer in (2.0, 10.0, -10.0):
        mission = resolve(overrides={key: (before + warmer, "K")})
        found = thermal.rate("nisp", "euclid_h", H, mission) / 0.02
        growth = (found - 0.5) / 0.5
        wien = np.exp(1.438776877e8 / 20200 * (1 / before - 1 / (before + warmer)))
        assert growth == pytest.approx(wien, rel=0.12)
        # Bluer light grows faster.
        blue = Passband("blue", np.arange(12000.0, 15000.0), np.ones(3000), "vacuum")
        assert (thermal.rate("nisp", "euclid_h", blue, mission) / 0.02 > found) == (warmer > 0)
