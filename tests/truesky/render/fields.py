"""Small synthetic fields for tests of the renderer: part of a detector with sources."""

from dataclasses import replace
from functools import cache
from types import MappingProxyType

import numpy as np
import pyarrow as pa

from lake_schema.ids import source_id
from lake_schema.mission.configuration import resolve
from lake_schema.tables.exposures import ExposureRow
from truesky.render.camera import astrometry, detectors
from truesky.render.channels import vis
from truesky.render.channels.aim import Aim
from truesky.render.exposure import render
from truesky.render.exposure.records import Rows, Variant
from truesky.render.psf import seeing
from truesky.render.sources import galaxy_shapes
from truesky.render.sources.source_list import Sources

MISSION = resolve()


@cache
def small(camera, name, n=160):
    """Return a detector cut to n x n pixels about its centre, all of which belong to one half."""
    return replace(detectors.detector(camera, name, MISSION), nx=n, ny=n, injection_rows=0)


@cache
def psf_of(camera, name="3-4"):
    """Return a narrow round PSF for VIS (other tests cover the optics), or the seeing disc for LSSTCam."""
    detector = small(camera, "R22_S11" if camera == "lsstcam" else name)
    if camera == "vis":
        return seeing.moffat_psf(0.16, 3.5, detector.pixel_scale)
    return seeing.moffat_psf(0.73, 3.0, detector.pixel_scale)


DEFAULTS = {
    "bulge_half_light_radius": 0.3,
    "disk_half_light_radius": 0.8,
    "bulge_fraction": 0.0,
    "bulge_sersic_index": 2.0,
    "bulge_axis_ratio": 1.0,
    "inclination": 0.0,
    "position_angle": 0.0,
    "kappa": 0.0,
    "gamma1": 0.0,
    "gamma2": 0.0,
}


def galaxies(ra, dec, **columns):
    """Return rows of galaxies with the columns that the renderer reads; scalars are repeated."""
    ra, dec = np.atleast_1d(ra).astype(float), np.atleast_1d(dec).astype(float)
    n = len(ra)
    table = {"id": source_id(0, 411_000, np.arange(n)), "ra": ra, "dec": dec}
    for name, value in {**DEFAULTS, **columns}.items():
        table[name] = np.broadcast_to(np.asarray(value, np.float32), n)
    return pa.table(table)


def stars(ra, dec):
    ra, dec = np.atleast_1d(ra).astype(float), np.atleast_1d(dec).astype(float)
    return pa.table({"id": source_id(5, 411_000, np.arange(len(ra))), "ra": ra, "dec": dec})


def fluxes(table, band, value):
    value = np.broadcast_to(np.asarray(value, np.float32), len(table))
    return pa.table({"id": table["id"], f"f_nu_{band}": value})


def one_source(detector, system, electrons=1e5, column=None, row=None, **shape):
    """Return a single galaxy, or a point if it has no shape, ready to draw."""
    column = np.array([(detector.nx - 1) / 2 if column is None else column])
    row = np.array([(detector.ny - 1) / 2 if row is None else row])
    jacobian = astrometry.jacobian(system, column, row)
    form = galaxy_shapes.shapes(galaxies(0.0, 0.0, **shape))
    which = np.array([0 if shape else -1])
    return Sources(np.array([1]), column, row, jacobian, np.array([float(electrons)]), which, form)


def moments(image):
    """Return the centroid (column, row) and second moments ((xx, xy), (xy, yy)) of an image in pixels."""
    total = image.sum()
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    centre = np.array([(image * x).sum(), (image * y).sum()]) / total
    dx, dy = x - centre[0], y - centre[1]
    xy = (image * dx * dy).sum()
    return centre, np.array([[(image * dx * dx).sum(), xy], [xy, (image * dy * dy).sum()]]) / total


def rendered(
    exposed,
    detector,
    tables,
    mission,
    accuracy,
    seed=1,
    forced=None,
    truth=(),
    progress=None,
    passband=None,
    noise_seed=None,
    way="raw",
    drawings=None,
    **rows,
):
    """Render one detector; `tables` contains galaxies, their fluxes, stars, and their fluxes.

    `exposed` contains columns of the exposure.
    """
    variant = Variant(mission, accuracy, forced or {})
    return render.render(
        Aim.from_exposure(exposure(**exposed), detector, passband, readout_name=way),
        Rows(*tables, **rows),
        variant,
        seed,
        truth,
        progress,
        noise_seed,
        drawings,
    )


def exposure(**known):
    """Return a row of the table `exposures`; only some columns matter.

    VIS has the radiation damage of its launch.
    """
    mjd = 60126.0 if known.get("camera", "vis") == "vis" else 60905.0
    nominal = {
        "exposure_id": 1, "channel": "VIS", "camera": "vis", "band": "euclid_vis", "image_type": "science",
        "ra": 0.0, "dec": 0.0, "position_angle": 0.0, "mjd": mjd, "exposure_time_s": 100.0,
        "sky": 0.0, "seeing": 0.0, "zero_point": 25.93, "survey": "test",
    }  # fmt: skip
    return ExposureRow(**{**nominal, **known})


def aimed(detector, system, band, exposed=MappingProxyType({}), channel=vis.CHANNEL):
    """Return a detector with a pointing in a default exposure."""
    return Aim(exposure(**exposed), detector, system, band, channel, channel.effects["science"])
