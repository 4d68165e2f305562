"""Nominal exposures of part of a NISP detector with given sources."""

from functools import cache

import numpy as np
import pytest

from tests.truesky.render import fields
from tests.truesky.render.fields import MISSION, fluxes, galaxies, small, stars
from truesky.fluxes import passbands
from truesky.render.camera import astrometry
from truesky.render.camera.pointing import boresight_for
from truesky.render.channels.aim import Aim
from truesky.render.planning import planned_exposures
from truesky.render.psf import euclid
from truesky.request.accuracy import SURVEY

SKY, SEED, MJD = 1.0, 1, 60905.0
TIME = 60 * MISSION.value("nisp.frame_time", "s")
_PSF = euclid.nisp_psf


@cache
def psf_of(detector, band):
    """Return the PSF of the detector, shared by all of its exposures."""
    return _PSF(detector, passbands.load(band), MISSION, 1)


def exposed(
    detector, kind="science", band="euclid_h", seconds=TIME, sky=SKY, number=1, mjd=MJD, mission=MISSION, lamp=None,
    **more,
):  # fmt: skip
    """Return columns of an exposure of a field at high ecliptic latitude."""
    ra, dec, angle = boresight_for(detector, 53.1, -27.8, 12.0)
    return {
        "exposure_id": number, "channel": "NISP-P", "camera": "nisp", "band": band, "image_type": kind, "ra": ra,
        "dec": dec, "position_angle": angle, "mjd": mjd, "exposure_time_s": seconds, "seeing": 0.0, "sky": sky,
        "zero_point": planned_exposures.zero_point_of("nisp", band, mission), "lamp": lamp, **more,
    }  # fmt: skip


def tables(detector, columns, mags, x, y, body=None):
    """Return rows and fluxes of stars (or galaxies with columns `body`) of AB magnitudes `mags` at pixels x, y."""
    system = Aim.from_exposure(fields.exposure(**columns), detector).wcs
    where = astrometry.sky_of_pixel(system, np.atleast_1d(x).astype(float), np.atleast_1d(y).astype(float))
    bodies, points = galaxies(*where, **(body or {})), stars(*where)
    bodies, points = (bodies, points.slice(0, 0)) if body else (bodies.slice(0, 0), points)
    f_nu = 10 ** (-0.4 * (np.atleast_1d(mags) - 23.9))
    band = columns["band"]
    return (
        bodies, fluxes(bodies, band, f_nu if body else 0.0), points, fluxes(points, band, 0.0 if body else f_nu),
    )  # fmt: skip


def rendered(
    mags=(), x=(), y=(), detector=None, body=None, forced=None, truth=(), mission=MISSION, accuracy=SURVEY,
    earlier=(), **columns,
):  # fmt: skip
    """Render a detector, by default of 96 x 96 pixels; `columns` are arguments of `exposed`."""
    detector = detector or small("nisp", "DET22", 96)
    row = exposed(detector, mission=mission, **columns)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(euclid, "nisp_psf", lambda d, band, *_: psf_of(d, row["band"]))
        found = tables(detector, row, mags, x, y, body)
        return fields.rendered(row, detector, found, mission, accuracy, SEED, forced, truth, previous_exposures=earlier)


def electrons(one):
    """Return the signal in electrons as float64[ny, nx]."""
    gain, bias = (one.scene.mission.value(f"nisp.{key}") for key in ("gain", "bias"))
    return (one.science - bias) * gain
