"""Nominal exposures of a VIS detector, or part of one, with given sources."""

from dataclasses import replace
from functools import cache, lru_cache

import numpy as np
import pytest

from tests.truesky.render import fields
from tests.truesky.render.fields import MISSION, fluxes, galaxies, stars
from truesky.fluxes import passbands
from truesky.render.camera import astrometry
from truesky.render.camera.pointing import boresight_for
from truesky.render.drawing.settings import settings_for
from truesky.render.planning import planned_exposures
from truesky.render.psf import euclid, model
from truesky.request.accuracy import SURVEY

TIME = MISSION.value("vis.exposure_time", "s")
SKY, SEED = 0.25, 1
# Exposures are taken on the days after this MJD, the launch, with the radiation damage of the beginning of the mission.
DAY = MISSION.value("svm.launch", "d")
COSMIC_RAYS = ("cosmic_rays", "readout_cosmic_rays")
# Effects that move or compress charge, which calibration does not correct.
CHARGE = ("parallel_cti", "serial_cti", "brighter_fatter")


def off(*names):
    """Return the request option that forces effects off."""
    return dict.fromkeys(names, False)


@cache
def psf_of(detector):
    """Return the PSF of the detector, shared by all of its exposures."""
    return euclid.vis_psf(detector, passbands.load("euclid_vis"), MISSION)


@lru_cache(maxsize=1)
def psf_with_transforms(detector, colours):
    """Return the PSF of the detector with at most `colours` wavelengths, which keeps its Fourier transforms.

    Exposures of the same detector share them. Those of one PSF alone are kept, because they are large.
    """
    return replace(model.reduce_colours(psf_of(detector), colours), derived={})


@cache
def pointing(detector):
    """Return the boresight and a small rotation for which the detector observes a field at high ecliptic latitude."""
    return boresight_for(detector, 53.1, -27.8, 12.0)


def rendered(
    detector, mags, x, y, body=None, mission=MISSION, forced=None, accuracy=SURVEY, seconds=TIME, sky=SKY,
    kind="science", number=1, truth=(), asteroids=None,
):  # fmt: skip
    """Render stars (or galaxies with columns `body`) of AB magnitudes `mags` at pixels x, y.

    `number` is the exposure number, which changes the noise but not the detector.
    """
    ra, dec, angle = pointing(detector)
    exposed = {
        "exposure_id": number, "channel": "VIS", "camera": "vis", "band": "euclid_vis", "image_type": kind,
        "ra": ra, "dec": dec, "position_angle": angle, "mjd": DAY + number, "exposure_time_s": seconds,
        "seeing": 0.0, "sky": sky, "zero_point": planned_exposures.zero_point_of("vis", "euclid_vis", mission),
    }  # fmt: skip
    system = astrometry.wcs(detector, ra, dec, angle)
    where = astrometry.sky_of_pixel(system, np.atleast_1d(x).astype(float), np.atleast_1d(y).astype(float))
    bodies, points = galaxies(*where, **(body or {})), stars(*where)
    bodies, points = (bodies, points.slice(0, 0)) if body else (bodies.slice(0, 0), points)
    f_nu = 10 ** (-0.4 * (np.atleast_1d(mags) - 23.9))
    with pytest.MonkeyPatch.context() as patch:
        if mission is MISSION:
            own = psf_with_transforms(detector, settings_for(accuracy).colours)
            patch.setattr(euclid, "vis_psf", lambda *_: own)
        tables = (
            bodies, fluxes(bodies, "euclid_vis", f_nu if body else 0.0),
            points, fluxes(points, "euclid_vis", 0.0 if body else f_nu),
        )  # fmt: skip
        return fields.rendered(exposed, detector, tables, mission, accuracy, SEED, forced, truth, bodies=asteroids)


def lattice(side, pitch, seed=1):
    """Return x, y of positions on a regular grid, each with a different subpixel phase."""
    rng = np.random.default_rng(seed)
    middle = np.arange(pitch / 2, side, pitch)
    x, y = (axis.ravel() for axis in np.meshgrid(middle, middle))
    return x + rng.uniform(-0.5, 0.5, len(x)), y + rng.uniform(-0.5, 0.5, len(y))
