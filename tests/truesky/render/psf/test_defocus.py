"""VIS out of focus: images are rings, in agreement with a sum over the pupil and with geometric optics."""

import numpy as np
import pytest

from lake_schema.mission.configuration import resolve
from tests.truesky import nightly
from truesky.fluxes import passbands
from truesky.render.camera.detectors import detector
from truesky.render.psf import diffraction, euclid

SAMPLING, SIDE, WAVELENGTH = 0.1 / 3, 301, 700.0


def at(nm):
    return resolve(overrides={"vis.psf.defocus": (nm, "nm")})


def image(nm, place=(0.4, -0.6)):
    """Return the diffracted light at a position in the field, without any blur."""
    mission = at(nm)
    own = euclid.wavefront(*place, "vis", mission)
    return diffraction.diffraction_image(own, diffraction.optics_of(10 * WAVELENGTH, SAMPLING, mission, 2048), SIDE)


def test_in_focus_it_is_the_psf_of_science_exposures():
    band = passbands.load("euclid_vis")
    mission = resolve()
    found = [euclid.vis_psf(detector("vis", "3-4", mission), band, own, 1) for own in (mission, at(0.0), at(300.0))]
    planes = [one.planes.images for one in found]
    assert planes[0].tobytes() == planes[1].tobytes()
    assert planes[2].max() < 0.2 * planes[0].max()


@nightly.parametrize("nm", [-300.0, 300.0], (1,))
def test_it_is_a_sum_over_the_pupil(nm):
    """Fraunhofer's integral is summed directly, without a transform, and with Noll's polynomials as printed."""
    mission, n = resolve(), 1500
    a = euclid.wavefront(0.4, -0.6, "vis", mission)
    axis = (np.arange(n) + 0.5) / n * 2.04 - 1.02
    x, y = np.meshgrid(axis, axis)
    r2 = x**2 + y**2
    wave = np.sqrt(3) * (a[4] + nm) * (2 * r2 - 1) + np.sqrt(6) * (a[5] * 2 * x * y + a[6] * (x**2 - y**2))
    wave += np.sqrt(8) * (3 * r2 - 2) * (a[7] * y + a[8] * x)
    wave += np.sqrt(8) * (a[9] * (3 * x**2 * y - y**3) + a[10] * (x**3 - 3 * x * y**2))
    wave += np.sqrt(5) * a[11] * (6 * r2**2 - 6 * r2 + 1)
    clear = diffraction.pupil(600 * x, 600 * y, 600 * 2.04 / n, mission)
    field = clear * np.exp(2j * np.pi * wave / WAVELENGTH)
    angle = np.radians((np.arange(SIDE) - SIDE // 2) * SAMPLING / 3600)
    # Light of a sample x in the pupil reaches the angle theta with the phase 2 pi x theta / lambda.
    turned = np.exp(2j * np.pi * np.outer(angle, axis * 0.6) / (WAVELENGTH * 1e-9))
    power = np.abs(turned @ field @ turned.T) ** 2
    step, sample = 0.6 * 2.04 / n, np.radians(SAMPLING / 3600)
    power *= (step**2 * sample / (WAVELENGTH * 1e-9)) ** 2 / (clear.sum() * step**2)
    ours = image(nm)
    np.testing.assert_allclose(ours, power, atol=2e-3 * power.max())


def test_a_ring_is_as_large_as_rays_make_it():
    """A wavefront W = a sqrt(3) (2 r^2 - 1) has the slope 4 sqrt(3) a over the radius at the rim."""
    light = image(300.0, (0.0, 0.0))
    y, x = np.mgrid[:SIDE, :SIDE] - SIDE // 2
    r = np.hypot(x, y) * SAMPLING
    # The field adds to the wavefront.
    nm = euclid.wavefront(0.0, 0.0, "vis", at(300.0))[4]
    rim = np.degrees(4 * np.sqrt(3) * nm * 1e-9 / 0.6) * 3600
    profile = np.array([light[(r >= low) & (r < low + 0.1)].mean() for low in np.arange(0.0, 1.5, 0.1)])
    # At the rim, the light falls to half of the ring's brightness.
    edge = np.arange(0.05, 1.5, 0.1)[np.flatnonzero(profile > 0.5 * profile[3:7].mean())[-1]]
    assert edge == pytest.approx(rim, abs=0.1)


def test_on_either_side_of_the_focus_the_pupil_is_upside_down():
    """The pupil has three bars and a stop off its centre. The shadows rotate by half a turn through the focus."""
    mission, one, other = at(0.0), *(np.zeros(5) for _ in range(2))
    one[4], other[4] = 300.0, -300.0
    optics = diffraction.optics_of(10 * WAVELENGTH, SAMPLING, mission, 2048)
    before, after = (diffraction.diffraction_image(nm, optics, SIDE) for nm in (one, other))
    np.testing.assert_allclose(before, after[::-1, ::-1], atol=1e-3 * before.max())
    assert np.abs(before - after).max() > 0.2 * before.max()
