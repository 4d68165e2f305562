"""Depth of one exposure, with the pixels' own PSF, sky and noise, against what surveys publish."""

import numpy as np
import pytest

from lake_schema.mission.configuration import resolve
from truesky.fluxes import passbands
from truesky.render.camera import detectors
from truesky.render.planning import planned_exposures
from truesky.render.psf import ground, to_psfex
from truesky.render.sky import diffuse_light

MISSION = resolve()


def depth(camera, band, ratio, seconds):
    """AB magnitude of a star whose S/N is `ratio` in the least scatter that its pixels allow."""
    section = f"ext.{camera}"
    every = detectors.detectors(camera, MISSION)
    detector = min(every, key=lambda one: np.hypot(one.x, one.y))
    air = ground.Air(MISSION.value(f"{section}.{band}.seeing", "arcsec"))
    psf = ground.atmospheric_psf(air, detector, passbands.load(band), MISSION, 1)
    (model, *_), *_ = to_psfex.psfex_planes(psf)
    every_pixel = slice((len(model) // 2) % psf.planes.samples, None, psf.planes.samples)
    share = psf.planes.samples**2 * model[every_pixel, every_pixel].astype(float)
    assert share.sum() == pytest.approx(1.0, abs=2e-3)
    sky = diffuse_light.ground_sky(detector, band, MISSION).constant
    noise = sky * seconds + MISSION.value(f"{section}.read_noise", "electron") ** 2
    light = np.geomspace(10.0, 1e6, 300)
    found = np.sqrt(((light[:, None, None] * share) ** 2 / (noise + light[:, None, None] * share)).sum(axis=(1, 2)))
    zero_point = planned_exposures.zero_point_of(section, band, MISSION)
    return zero_point - 2.5 * np.log10(np.interp(ratio, found, light) / seconds)


def bands(*published):
    """The first in every run."""
    return [pytest.param(*one, marks=[pytest.mark.nightly] if i else []) for i, one in enumerate(published)]


@pytest.mark.parametrize(("band", "published"), bands(("r", 23.34), ("g", 23.57), ("i", 22.78), ("z", 22.10)))
def test_des_is_as_deep_as_published(band, published):
    """Abbott et al. 2018: S/N 10 in a single exposure of 90 s."""
    assert depth("decam", f"des_{band}", 10.0, 90.0) == pytest.approx(published, abs=0.1)


@pytest.mark.parametrize(
    ("band", "effective", "published"),
    [("u", 0.92, 23.70), ("g", 0.87, 24.97), ("r", 0.83, 24.52), ("i", 0.80, 24.13), ("z", 0.78, 23.56),
     ("y", 0.76, 22.55)],
)  # fmt: skip
def test_lsst_s_light_and_sky_are_those_of_its_forecast(band, effective, published):
    """With the forecast's own effective FWHM and 9.1 e- of noise a pixel; what is left of a difference is our PSF's.

    Ref : Jones, SMTN-002, throughputs 1.9; 8.8 e- of reading and 0.2 e-/s of dark current
    """
    section, seconds = "ext.lsstcam", 30.0
    (detector, *_), name = detectors.detectors("lsstcam", MISSION), f"lsst_{band}"
    sky = diffuse_light.ground_sky(detector, name, MISSION).constant
    variance = (sky * seconds + 8.8**2 + 0.2 * seconds) * 2.266 * (effective / detector.pixel_scale) ** 2
    light = 0.5 * (5.0**2 + np.sqrt(5.0**4 + 4.0 * 5.0**2 * variance))
    zero_point = planned_exposures.zero_point_of(section, name, MISSION)
    assert zero_point - 2.5 * np.log10(light / seconds) == pytest.approx(published, abs=0.025)


@pytest.mark.parametrize(
    ("band", "published"), bands(("r", 24.52), ("u", 23.70), ("g", 24.97), ("i", 24.13), ("z", 23.56))
)
def test_lsst_is_as_deep_as_foretold(band, published):
    """S/N 5 in 30 s.  Theirs is of an effective area of 1.3 Gaussians of the FWHM; ours, with wings, of 1.6."""
    assert depth("lsstcam", f"lsst_{band}", 5.0, 30.0) == pytest.approx(published, abs=0.18)
