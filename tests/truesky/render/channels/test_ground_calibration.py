"""Biases, darks and dome flats of ground cameras: the plan follows DES, and each frame has independent noise."""

import warnings
from collections import Counter
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u

from lake_schema.tables.exposures import ExposureRow
from tests.truesky.render import fields
from tests.truesky.render.channels.test_ground import BANDS, NOBODY
from tests.truesky.render.channels.test_readout import put
from tests.truesky.render.fields import MISSION, fluxes
from tests.truesky.render.products import test_tools as tools
from truesky.fluxes import passbands
from truesky.reduction import files, masters, reduce
from truesky.reduction import frames as lake_frames
from truesky.reduction.frames import Frame
from truesky.render.camera import detectors
from truesky.render.channels import image_types
from truesky.render.effects.light import calibration_lamp, illumination, pixel_area
from truesky.render.plan_exposures import plan
from truesky.render.products import read_back
from truesky.request.accuracy import SURVEY
from truesky.request.from_toml import parse

PILOT = Path(__file__).parents[4] / "requests" / "sc8_pilot.toml"
SIDE, BLOCK, FRAMES = 256, 64, 7


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    """Return the calibrations of DES in the pilot phase: rows of the table `exposures`, and the table `tasks`."""
    request = parse(PILOT)
    own = tuple(b for b in request.observations if b.survey == "des" and b.image_type != "science")
    _, exposures, tasks = plan(tmp_path_factory.mktemp("none"), replace(request, observations=own, pointings=()))
    return exposures.to_pylist(), tasks


def test_forty_flats_and_ten_biases_are_planned(planned):
    exposures, tasks = planned
    flats, biases = ([row for row in exposures if row["image_type"] == kind] for kind in ("flat", "bias"))
    assert Counter(row["band"] for row in flats) == dict.fromkeys(("des_g", "des_r", "des_i", "des_z"), 10)
    assert len(biases) == 10
    assert len(tasks) == 50 * 62
    assert {row["exposure_time_s"] for row in flats} == {10.0}
    assert {row["exposure_time_s"] for row in biases} == {0.0}
    assert {(row["lamp"], row["sky"]) for row in flats} == {(1, 0.0)}
    assert not any(cells for cells in tasks["cells"].to_pylist())


def test_no_two_of_them_have_the_same_noise(planned):
    rows = [ExposureRow.from_row(row) for row in planned[0]]
    assert len({image_types.identity(row) for row in rows}) == len(rows)
    for kind in ("flat", "bias"):
        start = np.sort([row.mjd for row in rows if row.image_type == kind]) * 86400.0
        assert np.diff(start).min() > 10.0


@cache
def frame(camera, kind, number=1, seconds=10.0, forced=(), sky=0.0):
    """Return the electrons above zero [ny, nx] of a frame, with amplifier levels, and the rendered detector."""
    one = fields.small(camera, detectors.detectors(camera, MISSION)[0].name, SIDE)
    exposed = {
        "exposure_id": number, "channel": "EXT", "camera": camera, "band": BANDS[camera], "image_type": kind,
        "exposure_time_s": 0.0 if kind == "bias" else seconds, "mjd": 60905.0 + 0.01 * number, "seeing": 0.8, "lamp": 1,
        "sky": sky,
    }  # fmt: skip
    body, points = NOBODY
    tables = body, fluxes(body, BANDS[camera], []), points, fluxes(points, BANDS[camera], [])
    shown = fields.rendered(exposed, one, tables, MISSION, SURVEY, 1, forced=dict(forced))
    gain = np.reshape(shown.scene.amplifier_values("gain", "electron / adu"), (-1, 1, 1))
    raw = shown.raw.astype(float) * gain
    return shown.scene.layout.assemble(raw), shown


QUIET = (("cosmic_rays", False), ("brighter_fatter", False), ("nonlinearity", False))


@pytest.mark.parametrize("camera", ["decam", "lsstcam", "megacam"])
def test_a_flat_is_the_lamps_light_through_the_telescope(camera):
    (first, one), (second, _) = (frame(camera, "flat", number, forced=QUIET) for number in (1, 2))
    bias = np.mean([frame(camera, "bias", number)[0] for number in range(1, 5)], axis=0)
    level, *pattern = calibration_lamp.EFFECT.parameters(one.scene)
    assert level == MISSION.value(f"ext.{camera}.flat.signal", "electron")
    expected = level * illumination.apply(np.ones(first.shape), *pattern)
    expected = illumination.apply(expected, *illumination.EFFECT.parameters(one.scene))
    light = 0.5 * (first + second) - bias
    assert np.median(light / expected) == pytest.approx(1.0, abs=0.003)
    # The flat is vignetted like the sky.
    assert abs(1.0 - expected.mean() / level) > 0.01
    # The two flats have independent shot noise.
    difference = first - second
    spread = 1.4826 * np.median(np.abs(difference - np.median(difference)))
    assert spread == pytest.approx(np.sqrt(2.0 * expected.mean()), rel=0.03)


@pytest.mark.parametrize("camera", ["decam", "hsc"])
def test_biases_have_read_noise_of_their_own_and_a_pattern_in_common(camera):
    """Sample of four frames; the pattern exceeds noise at a significance of 6e-7 (5 standard errors)."""
    frames = np.array([frame(camera, "bias", number)[0] for number in range(1, 5)])
    _, one = frame(camera, "bias")
    noise = np.hypot(*(np.mean(one.scene.amplifier_values(*key)) / part for key, part in (
        (("read_noise", "electron"), 1.0), (("gain", "electron / adu"), np.sqrt(12.0)))))  # fmt: skip
    for i in range(4):
        for j in range(i):
            assert (frames[i] - frames[j]).std() == pytest.approx(np.sqrt(2.0) * noise, rel=0.03)
    # Amplifiers settle while a row is read, so all biases have the same column pattern.
    columns = frames.mean(axis=(0, 1))
    assert np.ptp(columns) > 5.0 * noise / np.sqrt(4.0 * SIDE)
    assert {d.name for d in one.decisions} & {"poisson", "background", "cosmic_rays"} == set()


def test_a_dark_has_dark_current_and_no_light():
    dark, one = frame("lsstcam", "dark", seconds=4000.0, forced=QUIET)
    bias = np.mean([frame("lsstcam", "bias", number)[0] for number in range(1, 5)], axis=0)
    assert np.median(dark - bias) == pytest.approx(one.scene.dark_electrons, rel=0.03)
    assert one.scene.dark_electrons > 50.0
    assert not one.noise_free.any()
    assert len(one.sources) == 0


def stored(one, folder):
    """Write the raw file of a rendered detector, and return it as a frame for the reduction."""
    path = put(one, folder)["science"]
    cards, scene = read_back.header(path), replace(one.scene, band=passbands.load(one.exposure.band))
    return Frame(path, one.exposure, scene, lake_frames._applied_effects(cards), cards)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """Return a folder with master biases and flats of DECam, and a frame of the sky alone."""
    folder = tmp_path_factory.mktemp("calibrated")
    kinds = ((kind, number) for kind in ("bias", "flat") for number in range(1, FRAMES + 1))
    raw = [stored(frame("decam", kind, number + 50 * (kind == "flat"))[1], folder) for kind, number in kinds]
    made = [(kind, own) for kind, master, own in masters.from_frames(raw, folder) if write(folder, master, kind, own)]
    assert [(kind, len(own)) for kind, own in made] == [("bias", FRAMES), ("flat", FRAMES)]
    return folder, stored(frame("decam", "science", 200, 90.0, QUIET[:1], 100.0)[1], folder)


def write(folder, master, kind, own):
    path = files.master_path(folder, own[0], kind)
    files.write_master(path, master, kind, own)
    return path.is_file()


def check_flat(found, scene):
    """Blocks of 64 x 64 pixels deviate by less than 0.3 % from the sky, which is fainter far from the axis."""
    nothing = np.full((SIDE, SIDE), scene.dark_electrons + scene.sky_electrons)
    expected = pixel_area.apply(nothing, *pixel_area.parameters(scene)).mean()
    blocks = np.nanmean(found.reshape(SIDE // BLOCK, BLOCK, SIDE // BLOCK, BLOCK), axis=(1, 3)) / expected - 1.0
    print(f"blocks: mean {blocks.mean():.5f}, rms {blocks.std():.5f}, largest {np.abs(blocks).max():.5f}")
    assert np.abs(blocks).max() < 0.003
    return blocks


def test_ccdproc_with_the_masters_leaves_a_flat_sky(calibrated):
    """Amplifiers are reduced by the header, then with the master bias and the master flat, which has the vignetting."""
    ccdproc = pytest.importorskip("ccdproc", reason="ccdproc is not installed (extra test)")
    folder, science = calibrated
    (bias, _), (flat, _) = (
        files.read_master(files.master_path(folder, science, kind), kind, science) for kind in ("bias", "flat")
    )
    found = np.full((SIDE, SIDE), np.nan)
    for text, image in tools.reduced(science.path):
        place = tools.window(text)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            light = ccdproc.subtract_bias(image, ccdproc.CCDData(bias.mean[place], unit=u.electron))
            even = ccdproc.flat_correct(light, ccdproc.CCDData(flat.mean[place], unit=""), norm_value=1.0)
        found[place] = np.where(flat.mean[place] > 0.7, even.data, np.nan)
    # Without the flat, the vignetting is visible.
    raw = read_back.electrons(science.path).data
    assert abs(np.median(raw) / science.scene.sky_electrons - 1.0) > 0.02
    check_flat(found, science.scene)


def test_our_reduction_does_so_too(calibrated):
    """The reduction corrects the vignetting exactly once."""
    folder, science = calibrated
    # The expected sky has the area of each pixel.
    options = reduce.ReductionOptions(without=("dark", "pixel_area"))
    image, _ = reduce.reduce_frame(science, files.read_masters(folder, science, ("dark",)), options)
    assert (image.weight > 0.0).mean() > 0.9
    check_flat(np.where(image.weight > 0.0, image.image, np.nan), science.scene)
