"""Trails of satellites in the pixels of a map, without images."""

import json
from dataclasses import replace

import numpy as np
import pytest

from lake_schema import sky
from lake_schema.mission.configuration import resolve
from lake_schema.tables.survey.depth import ORDER, SATELLITE
from tests.truesky.render import fields
from truesky.fluxes import passbands
from truesky.render.camera import detectors, pointing
from truesky.render.planning import variants
from truesky.request.schema import Effects
from truesky.survey_maps import satellite_masks
from truesky.survey_maps.pixel_overlap import PixelGrid, side_normals

from . import planned

CELL = int(sky.cell_at([30.0], [-10.0], 7)[0])
RA, DEC = (float(axis) for axis in sky.cell_centre(7, CELL))
RATE = "survey.satellites.rate"
CROSSED = resolve(overrides={RATE: (0.05, "1 / (deg s)")})


@pytest.fixture(scope="module")
def grid():
    return PixelGrid.from_cell(7, CELL, ORDER)


@pytest.fixture(scope="module")
def exposures():
    """Return three exposures of LSSTCam, and the normals of two small detectors in each."""
    one = fields.exposure(
        channel="EXT", camera="lsstcam", band="lsst_r", exposure_time_s=30.0, sky=33.0, seeing=0.8, zero_point=28.36,
        ra=RA, dec=DEC, position_angle=20.0, zenith=30.0, airmass=1.2,
    )  # fmt: skip
    rows = [replace(one, exposure_id=number, mjd=60905.0 + number) for number in range(3)]
    side = np.array([-400.0, 400.0, 400.0, -400.0])
    corners = [
        np.stack(pointing.sky_of_plane(side + x, np.roll(side, -1), RA, DEC, 20.0), axis=-1) for x in (-450.0, 450.0)
    ]
    return rows, {row.exposure_id: side_normals(np.array(corners)) for row in rows}


def predict(exposures, grid, mission=CROSSED, request=None):
    rows, normals = exposures
    request = request or planned.request()
    return satellite_masks.predict(rows, normals, request, (passbands.load("lsst_r"), mission), grid)


def test_masks_are_those_of_each_pixel_trail_and_detector(exposures, grid):
    """The slow reference compares all pixels with all trails and with all sides of all detectors at once."""
    rows, normals = exposures
    request, radius = planned.request(), grid.pixel_radius
    expected = np.zeros(len(grid.centres), bool)
    setup = variants.variant(None, CROSSED, request.accuracy, {}), detectors.detectors("lsstcam", CROSSED)
    for row in rows:
        x, y, _ = pointing.plane_of_sky(grid.centres, RA, DEC, row.position_angle)
        inside = (grid.centres[:, None, None] * normals[row.exposure_id]).sum(axis=-1).min(axis=-1).max(
            axis=-1
        ) > -radius
        for trail in satellite_masks.trails(row, request, passbands.load("lsst_r"), setup):
            distance = np.abs(np.cos(trail.direction) * y - np.sin(trail.direction) * x - trail.offset)
            expected |= inside & (distance < trail.half_width + radius / pointing.ARCSEC)
    np.testing.assert_array_equal(predict(exposures, grid), np.where(expected, SATELLITE, 0))
    assert 0.01 < expected.mean() < 0.9


def test_there_are_no_trails_without_satellites(exposures, grid):
    off = replace(planned.request(), effects=Effects(off=("satellite_trails",)))
    assert not predict(exposures, grid, resolve()).any()
    assert not predict(exposures, grid, request=off).any()
    rows, normals = exposures
    in_space = [replace(row, channel="VIS", camera="vis") for row in rows]
    assert not predict((in_space, normals), grid).any()


def test_the_rate_of_an_exposure_is_its_own(exposures, grid):
    """Of the exposures in a sky with satellites, those with a rate of 0 in their settings have no trail."""
    rows, normals = exposures
    own = json.dumps({f"own:{RATE}": [0.0, "1 / (deg s)"]})
    alone = [predict(([row], normals), grid) for row in rows]
    assert any(bits.any() for bits in alone)
    for row, bits in zip(rows, alone, strict=True):
        mixed = [one if one is row else replace(one, settings=own) for one in rows]
        np.testing.assert_array_equal(predict((mixed, normals), grid), bits)
