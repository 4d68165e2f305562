"""A PSF of two Gaussians with given radii: its light, and spectra through it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from tests.truesky.render import spectroscopic
from truesky.render.camera import detectors
from truesky.render.psf import double_gaussian

NO_BODIES = {"env.solar_system.density": (0.0, "deg-2")}
GAUSSIANS = resolve(overrides={**NO_BODIES, "nisp.spectra.psf": (1.0, "")})


CORE = GAUSSIANS.value("nisp.spectra.core", "")


def within(radius, widths, core=CORE):
    light = zip((core, 1.0 - core), widths, strict=True)
    return 1.0 - sum(part * np.exp(-0.5 * (radius / width) ** 2) for part, width in light)


@given(st.floats(0.01, 1.0), st.floats(1.53, 6.0), st.floats(0.55, 0.79))
def test_half_and_four_fifths_of_the_light_are_within_the_radii(ee50, ratio, core):
    widths = double_gaussian.widths(ee50, ee50 * ratio, core)
    assert within(ee50, widths, core) == pytest.approx(0.5, abs=1e-6)
    assert within(ee50 * ratio, widths, core) == pytest.approx(0.8, abs=1e-6)
    assert widths[0] < widths[1]


def test_known_widths():
    """The radii are EE50 and EE80 in Y, J and H, arcsec."""
    for radii, wanted in (((0.148, 0.370), (0.097, 0.410)), ((0.168, 0.448), (0.110, 0.497)),
                          ((0.206, 0.565), (0.134, 0.627))):  # fmt: skip
        assert double_gaussian.widths(*radii, CORE) == pytest.approx(wanted, abs=2e-3)


def test_radii_of_one_gaussian_or_nearer_give_one():
    for ratio in (1.2, 1.5, 1.523):
        narrow, wide = double_gaussian.widths(0.2, 0.2 * ratio, CORE)
        assert narrow == wide == pytest.approx(0.2 / 1.17741, rel=1e-4)


@pytest.mark.parametrize("radii", [(0.0, 1.0), (0.3, 0.3), (0.4, 0.3), (float("nan"), 1.0)])
def test_radii_that_do_not_rise_are_refused(radii):
    with pytest.raises(BadInput, match="must be positive and increase"):
        double_gaussian.widths(*radii, CORE)


@pytest.mark.parametrize("core", [0.5, 0.8, float("nan")])
def test_core_without_a_solution_for_two_gaussians_is_refused(core):
    with pytest.raises(BadInput, match=r"between 0\.5 and 0\.8 of the light, got"):
        double_gaussian.widths(0.2, 0.5, core)


def test_the_core_is_a_value_of_the_mission():
    detector, waves = detectors.detector("nisp", "DET22", GAUSSIANS), np.array([15_000.0])
    images = []
    for core in (0.6, 0.75):
        own = GAUSSIANS.with_overrides({"nisp.spectra.core": (core, "")})
        images.append(double_gaussian.psf_at(detector, waves, own).planes.images[0].astype(float))
    assert np.abs(images[0] - images[1]).max() > 0.05 * images[0].max()


@pytest.mark.parametrize("key", ["spectra.psf", "spectra.selection", "ipc_spectroscopic", "nonlinearity_of_signal"])
def test_switches_are_0_or_1(key):
    """There is no value between the two choices."""
    with pytest.raises(BadInput, match=f"nisp.{key} = 0.3 is not a whole number"):
        resolve(overrides={f"nisp.{key}": (0.3, "")})
    for value in (0.0, 1.0):
        assert resolve(overrides={f"nisp.{key}": (value, "")}).value(f"nisp.{key}", "") == value


def test_the_planes_have_the_radii_of_their_wavelengths():
    waves = np.array([12_000.0, 15_000.0, 18_500.0])
    detector = detectors.detector("nisp", "DET22", GAUSSIANS)
    found = double_gaussian.psf_at(detector, waves, GAUSSIANS)
    side = np.arange(len(found.planes.images[0])) - len(found.planes.images[0]) // 2
    away = np.hypot(*np.meshgrid(side, side)) * detector.pixel_scale / found.planes.samples
    for wavelength, image in zip(waves, found.planes.images.astype(float), strict=True):
        assert image.sum() == pytest.approx(1.0, abs=1e-6)
        for part, light, slope in (("50", 0.5, 0.085), ("80", 0.8, 0.284)):
            radius = GAUSSIANS.value(f"nisp.spectra.ee{part}", "arcsec") + slope * (wavelength - 15_000.0) / 1e4
            # A ring of samples contains at most 5 % of the light.
            assert image[away < radius].sum() == pytest.approx(light, abs=0.03)


def test_spectra_keep_flux_and_width_of_the_double_gaussian():
    """One parameter selects the PSF. The profile across a star's spectrum is that of the Gaussians in a pixel."""
    missions = resolve(overrides=NO_BODIES), GAUSSIANS
    default, gaussian = (spectroscopic.rendered([18.0], [300.0], [48.0], mission=own) for own in missions)
    assert gaussian.noise_free.sum() == pytest.approx(default.noise_free.sum(), rel=0.01)
    assert not np.allclose(gaussian.noise_free, default.noise_free, rtol=0.05, atol=1.0)
    # These columns are near 1.5 um.
    light = gaussian.noise_free[:, 300:310].sum(axis=1, dtype=float)
    rows, widths = np.arange(len(light)), double_gaussian.widths(0.184, 0.490, CORE)
    middle = np.average(rows, weights=light)
    near = np.abs(rows - middle) < 1.5
    edges = (np.abs(rows[near, None] - middle + np.linspace(-0.5, 0.5, 41)) * 0.3)[..., None] / np.array(widths)
    line = np.exp(-0.5 * edges**2) / (np.sqrt(2 * np.pi) * np.array(widths)) * 0.3
    expected = (line.mean(axis=1) * np.array([CORE, 1.0 - CORE])).sum(axis=1)
    np.testing.assert_allclose(light[near] / light.sum(), expected, rtol=0.05)
