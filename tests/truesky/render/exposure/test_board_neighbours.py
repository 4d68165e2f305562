"""Crosstalk between detectors: what bright stars on one put into the others of its board."""

from dataclasses import asdict
from functools import cache

import numpy as np
import pyarrow as pa
import pytest

from lake_schema.mission.configuration import resolve
from tests.truesky import nightly
from tests.truesky.render import fields
from tests.truesky.render.fields import MISSION, fluxes, galaxies, small, stars
from tests.truesky.render.sources.test_catalogue_rows import Files
from truesky.render.camera import amplifiers, detectors
from truesky.render.camera.astrometry import pixel_of_sky, sky_of_pixel, wcs
from truesky.render.channels.aim import Aim
from truesky.render.drawing.stored_drawing import DrawingStore
from truesky.render.effects.charge import bleeding
from truesky.render.effects.readout import quadrants
from truesky.render.exposure import board_neighbours
from truesky.render.exposure.records import NeighbourDetector, Variant
from truesky.render.products import keys
from truesky.render.sources import catalogue_rows, selection
from truesky.request.accuracy import SURVEY

SIDE, SECONDS, POINTING = 256, 90.0, (150.0, 2.0, 0.0)
PAIRS = {"decam": ("S29", "S30", "des_r", "EXT"), "vis": ("3-4", "3-5", "euclid_vis", "VIS")}
QUIET = {"cosmic_rays": False, "readout_cosmic_rays": False}


def exposed(camera, sky=1.0):
    *_, band, channel = PAIRS[camera]
    return {
        "channel": channel, "camera": camera, "band": band, "exposure_time_s": SECONDS, "sky": sky, "seeing": 0.8,
        "zero_point": 27.0, "ra": POINTING[0], "dec": POINTING[1],
    }  # fmt: skip


def beside(camera, places, electrons, order=slice(None)):
    """Stars at columns and rows of the other detector."""
    _, other, band, _ = PAIRS[camera]
    d = small(camera, other, SIDE)
    points = stars(*sky_of_pixel(wcs(d, *POINTING), *np.transpose(places)))
    light = fluxes(points, band, np.asarray(electrons) / (10 ** (0.4 * (27.0 - 23.9)) * SECONDS))
    rows = np.arange(len(points))[order]
    return NeighbourDetector(d, points.take(rows), light.take(rows))


def rendered(camera, others, mission=MISSION, detector=None, own=((), ()), drawings=None):
    name, *_, band, _ = PAIRS[camera]
    none, points = galaxies([], []), stars(*own) if len(own[0]) else stars([], [])
    light = fluxes(points, band, 3e6 / (10 ** (0.4 * (27.0 - 23.9)) * SECONDS))
    tables = none, fluxes(none, band, []), points, light
    shown = detector or small(camera, name, SIDE)
    return fields.rendered(
        exposed(camera), shown, tables, mission, SURVEY, forced=QUIET, neighbours=others, drawings=drawings
    )


@cache
def stronger(camera, coefficient=1e-3):
    section = "vis" if camera == "vis" else f"ext.{camera}"
    return resolve(overrides={f"{section}.crosstalk_detectors": (coefficient, "")})


def in_order(camera, frame, detector):
    """A detector's pixels as they are read."""
    if camera == "vis":
        pixels = (MISSION.value(f"vis.fpa.{key}", "pix") for key in ("prescan", "overscan", "parallel_overscan"))
        return quadrants.apply(frame, *(int(n) for n in pixels), detector.injection_rows)
    return amplifiers.layout(detector, MISSION).split(frame)


@nightly.parametrize("camera", PAIRS, (0,))
def test_the_coefficient_is_recovered(camera):
    """From two raw frames, one of which has a full star on the other detector: what that one's own frame has."""
    mission, places, light = stronger(camera), [(60.3, 40.8), (200.0, 180.0)], [3e6, 4e6]
    other = beside(camera, places, light)
    one, empty = (rendered(camera, some, mission) for some in ((other,), ()))
    # Render the other detector alone.
    ra, dec = (other.stars[axis].to_numpy() for axis in ("ra", "dec"))
    none, band = galaxies([], []), PAIRS[camera][2]
    own = fields.rendered(
        exposed(camera), other.detector, (none, fluxes(none, band, []), other.stars, other.fluxes), MISSION, SURVEY
    )
    full = np.min(own.scene.amplifier_values("full_well", "electron"))
    np.testing.assert_allclose(np.transpose(pixel_of_sky(own.wcs, ra, dec)), places, atol=1e-6)
    held = bleeding.apply(np.maximum(np.floor(own.noise_free), 0.0), *bleeding.parameters(own.scene))
    held = in_order(camera, held, own.detector)
    gain = np.reshape(one.scene.amplifier_values("gain", "electron / adu"), (-1, 1, 1))
    change = (one.raw.astype(float) - empty.raw) * gain
    some = held > 0.05 * full
    assert some.sum() > 10
    assert (change[some] * held[some]).sum() / (held[some] ** 2).sum() == pytest.approx(1e-3, rel=0.1)
    assert change.max() == pytest.approx(1e-3 * held.max(), rel=0.1)
    # Nothing else.
    far = in_order(camera, np.asarray(own.noise_free < 1e-4 * full), own.detector) & (held < 1e-4 * full)
    assert np.abs(change[far]).max() < 1.01 * gain.max()


@nightly.parametrize("camera", PAIRS, (1,))
def test_an_image_with_an_additional_star_has_the_same_crosstalk_if_it_is_kept(camera):
    """The star is so bright that VIS takes the response inside a pixel into account, which changes other stars."""
    mission, others = stronger(camera), (beside(camera, [(60.3, 40.8), (200.0, 180.0)], [3e6, 4e6]),)
    name, *_ = PAIRS[camera]
    own = [np.asarray(at) for at in sky_of_pixel(wcs(small(camera, name, SIDE), *POINTING), [101.0], [99.0])]
    store = DrawingStore(lambda ids: np.ones(len(ids), bool))
    empty = rendered(camera, others, mission, drawings=store)
    kept = rendered(camera, others, mission, own=own, drawings=store)
    alone = rendered(camera, others, mission, own=own)
    assert empty.scene.neighbour_charge is not None
    assert len(alone.sources) == 1
    np.testing.assert_array_equal(kept.raw, alone.raw)
    np.testing.assert_array_equal(kept.scene.neighbour_charge.electrons, alone.scene.neighbour_charge.electrons)
    if camera == "vis":
        assert empty.psf.intra_pixel != alone.psf.intra_pixel


@pytest.mark.parametrize("camera", PAIRS)
def test_charge_of_the_columns_with_bright_stars_is_that_of_whole_frames(camera, monkeypatch):
    """A star that bleeds, stars at the border and at a corner, and one that is too faint to be noticed."""
    places = [(60.3, 40.8), (200.0, 180.0), (2.0, 120.5), (SIDE - 1.4, SIDE - 2.3), (130.0, 90.0)]
    others, mission = (beside(camera, places, [8e6, 4e6, 2e6, 3e6, 3e3]),), stronger(camera)
    drawn_columns = []

    def record(drawn, threshold):
        drawn_columns.append(groups := bright_columns(drawn, threshold))
        return groups

    bright_columns = board_neighbours._bright_columns
    monkeypatch.setattr(board_neighbours, "_bright_columns", record)
    few = rendered(camera, others, mission).scene.neighbour_charge
    monkeypatch.setattr(board_neighbours, "_bright_columns", lambda drawn, threshold: [(0, SIDE)])
    whole = rendered(camera, others, mission).scene.neighbour_charge
    assert len(few.pixel) > 200
    np.testing.assert_array_equal(few.pixel, whole.pixel)
    np.testing.assert_array_equal(few.electrons, whole.electrons)
    ((*groups,),) = drawn_columns
    assert len(groups) > 1
    assert sum(past - first for first, past in groups) < 0.9 * SIDE


def test_the_order_of_the_rows_changes_nothing():
    mission, places, light = stronger("decam"), [(60.3, 40.8), (62.0, 44.0), (200.0, 180.0)], [3e6, 8e5, 4e6]
    here, there = (
        rendered("decam", (beside("decam", places, light, order),), mission).raw for order in (slice(None), [2, 0, 1])
    )
    np.testing.assert_array_equal(here, there)


def test_faint_stars_are_not_drawn():
    one = rendered("decam", (beside("decam", [(60.3, 40.8)], [1e4]),))
    assert one.scene.neighbour_charge is None
    np.testing.assert_array_equal(one.raw, rendered("decam", ()).raw)
    (decision,) = (d for d in one.decisions if d.name == "detector_crosstalk")
    assert not decision.applied


@pytest.mark.parametrize(
    ("camera", "sky", "forced", "shows"),
    [
        ("decam", 10.0, {}, True),
        ("decam", 10.0, {"detector_crosstalk": False}, False),
        # With this bright sky, the crosstalk of a full pixel is below the noise.
        ("decam", 1e5, {}, False),
        ("decam", 1e5, {"detector_crosstalk": True}, True),
        ("vis", 0.2, {}, True),
    ],
)
def test_catalogues_are_read_only_where_a_full_pixel_would_be_noticed(camera, sky, forced, shows):
    aim = Aim.from_exposure(fields.exposure(**exposed(camera, sky)), small(camera, PAIRS[camera][0], SIDE))
    variant = Variant(MISSION, SURVEY, forced)
    assert board_neighbours.is_noticeable(aim, variant) is shows
    # Otherwise no table is read.
    assert shows or board_neighbours.bright_stars({}, aim, variant) == ()


@pytest.mark.parametrize("camera", ["vis", "decam", "lsstcam", "megacam", "hsc", "jpcam", "nisp"])
def test_detectors_of_a_board_see_each_other(camera):
    board = {d.name: {o.name for o in board_neighbours.other_detectors(camera, d.name, MISSION)} for d in
             detectors.detectors(camera, MISSION)}  # fmt: skip
    for name, others in board.items():
        assert name not in others
        assert all(board[other] == others - {other} | {name} for other in others)


def test_boards_are_where_they_are():
    """Of LSSTCam rows of a raft, of VIS halves of a row."""
    for camera, name, others in (("lsstcam", "R22_S11", ["R22_S10", "R22_S12"]), ("vis", "3-4", ["3-5", "3-6"])):
        assert [d.name for d in board_neighbours.other_detectors(camera, name, MISSION)] == others


def test_a_product_is_of_the_stars_on_its_board():
    """Change a file two detectors away: the product depends on files of stars, not of galaxies."""
    exposed = fields.exposure(exposure_id=1, camera="lsstcam", channel="EXT", band="lsst_u", psf="")
    own, other = (detectors.detector("lsstcam", name, MISSION) for name in ("R22_S10", "R22_S12"))
    task = {**board_neighbours.detector_circle(exposed, own), "exposure_id": 1, "detector": own.name, "cells": 1}
    far = set(selection.cells_within_reach(board_neighbours.detector_circle(exposed, other), 0.0, 0.0))
    far -= set(selection.cells_within_reach(task, 0.0, catalogue_rows.FARTHEST))
    assert far
    cells, found = {"near": selection.cells_of_task(task, 0.0), "far": sorted(far)}, []
    for changed in ("", "stars", "galaxies"):
        inputs = {
            name: Files((), cells, {"near": "a", "far": "b" if name == changed else "a"})
            for name in ("galaxies", "stars", "galaxy_fluxes", "star_fluxes")
        }
        facts = {"request": {}, "mission": "m", "code": "c"}
        found += keys.product_keys(facts, pa.Table.from_pylist([asdict(exposed)]), [task], inputs, MISSION)
    without, stars_, galaxies_ = found
    assert stars_ != without
    assert galaxies_ == without
