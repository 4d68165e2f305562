"""Raw frames of sections of detectors, rendered from the exposures of a plan, with stars or without sources."""

from dataclasses import replace

import numpy as np

from lake_schema.mission.configuration import resolve
from lake_schema.tables.exposures import ExposureRow
from tests.truesky.render import fields
from truesky.fluxes import passbands
from truesky.reduction import frames as lake_frames
from truesky.reduction.frames import Frame
from truesky.render.camera import astrometry, detectors
from truesky.render.channels.aim import Aim
from truesky.render.exposure import render
from truesky.render.exposure.records import Rows, Variant
from truesky.render.plan_exposures import plan
from truesky.render.products import fits_files, head_files, read_back
from truesky.request.accuracy import SURVEY

from . import planned

SEED = 3
MISSION = resolve()


def exposures(folder):
    """Return the first exposure of each channel in the plan of `planned.request`."""
    _, rows, _ = plan(folder, planned.request())
    found = {}
    for row in map(ExposureRow.from_row, rows.to_pylist()):
        found.setdefault(row.channel, row)
    return found


def section(camera, name, side, mission=MISSION):
    """Return a detector cut to side x side pixels about its centre."""
    return replace(detectors.detector(camera, name, mission), nx=side, ny=side, injection_rows=0)


def rendered(folder, exposure, detector, stars=((), ()), mission=MISSION, truth=()):
    """Render a detector with stars, (columns and rows, f_nu in microjansky), and return the frame and its maps."""
    band = passbands.load(exposure.band)
    (place, flux), none = stars, fields.galaxies([], [])
    system = astrometry.wcs(detector, exposure.ra, exposure.dec, exposure.position_angle)
    points = fields.stars(*astrometry.sky_of_pixel(system, *(place if len(place) else ([], []))))
    tables = none, fields.fluxes(none, exposure.band, 0.0), points, fields.fluxes(points, exposure.band, flux)
    one = render.render(
        Aim.from_exposure(exposure, detector, band), Rows(*tables), Variant(mission, SURVEY, {}), SEED, truth
    )
    rows, writers = fits_files.products(one, truth)
    folder.mkdir(parents=True, exist_ok=True)
    name, path = rows["path"][0].as_py(), folder / f"{exposure.channel}.fits"
    writers[name](path)
    if head_files.head_path(name) in writers:
        writers[head_files.head_path(name)](path.with_suffix(".head"))
    cards = read_back.header(path)
    scene = replace(one.scene, band=band)
    return Frame(path, exposure, scene, lake_frames._applied_effects(cards), cards), one


def magnitudes_to_flux(magnitude):
    """Return flux densities in microjansky of AB magnitudes."""
    return 10.0 ** (-0.4 * (np.asarray(magnitude) - 23.9))
