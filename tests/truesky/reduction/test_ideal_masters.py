"""Compare the calibration without masters with the patterns of a rendered ramp and of a rendered CCD."""

from pathlib import Path

import numpy as np
import pytest

from lake_schema.store import layout, publish, read
from tests import requests
from tests.truesky.render.test_render_exposures_calibration import small_detectors
from tests.truesky.render.test_render_exposures_infrared import MODULES
from truesky.emulator import frame_examples, train
from truesky.emulator.frame_examples import Settings
from truesky.randomness.rng import stream
from truesky.reduction import files, ideal_masters
from truesky.reduction.calibration import HOT, RESPONSE
from truesky.reduction.infrared import nisp
from truesky.render.effects.charge import dark_map, pixel_response
from truesky.render.products import read_back
from truesky.request.from_toml import parse

SEED, SIDE = 3, 192
REQUEST = """
accuracy = "draft"
[sources]
only = "table"
band = "euclid_j"
stars = "stars.csv"
[products]
truth = ["noise_free"]
[[pointing]]
channel = "{0}"
camera = "{1}"
band = "{2}"
ra = 53.117
dec = -27.808
centre_on = "{3}"
detectors = ["{3}"]
mjd = 60905.0
"""
RAMP, CCD = ("NISP-P", "nisp", "euclid_j", "DET22"), ("VIS", "vis", "euclid_vis", "3-4")


def render(folder, pointing):
    """Render a detector with two stars, and return the frame, its true sources, and its noise-free image.

    `pointing` has the channel, the camera, the band and the detector.
    """
    root = layout.resolve_lake(folder / "lake")
    (folder / "stars.csv").write_text("ra,dec,mag\n53.117,-27.808,20.0\n53.119,-27.807,20.0\n")
    text = REQUEST.format(*pointing)
    wanted = parse(requests.written(folder, text, requests.FIELD.format(0.05), seed=SEED))
    with small_detectors(SIDE):
        for module in MODULES:
            for step in module.steps(root, wanted):
                publish.make_version(root, step.plan, step.run_task)
        (frame,) = train.frames_of_band(root, pointing[2], (), (), None)
    sources = train.true_sources(read.version(root, "rendered_truth"), frame, np.zeros(0, np.int64), np.zeros(0))
    products = read.version(root, "products")
    (path,) = (row["path"] for row in products.rows().to_pylist() if row["content"] == "noise_free")
    return frame, sources, read_back.image_file(products, path)


@pytest.fixture(scope="module")
def ramp(tmp_path_factory):
    return render(tmp_path_factory.mktemp("ramp"), RAMP)


def constant_masters(frame, hot_electrons):
    """Replace `ideal_masters.ideal_masters`: masters that know no pattern."""
    read = nisp.read_masters if frame.scene.ramp else files.read_masters
    return read(Path(), frame, ideal_masters.replaced_kinds(frame))


def correlation(values, response):
    """Return the correlation of blank pixels with the response of the detector."""
    middle = np.median(values)
    spread = 1.48 * np.median(np.abs(values - middle))
    blank = (np.abs(values - middle) < 3.0 * spread) & (np.abs(response - 1.0) < 0.2)
    return np.corrcoef(values[blank], response[blank])[0, 1]


def check_response(frame, camera, least):
    """Compare the pixels of a frame with the response of the detector as the renderer draws it."""
    numbers = stream(SEED, camera, frame.detector, "pixel_response")
    shape, parameters = (frame.scene.ny, frame.scene.nx), pixel_response.parameters(frame.scene)
    response = pixel_response.response(shape, *parameters, numbers)
    image, _ = frame_examples._calibrate(frame, None)
    assert correlation(frame.electrons(), response) > least
    assert abs(correlation(image.image, response)) < 0.04
    assert ((image.flags & RESPONSE != 0) == (np.abs(response - 1.0) > 0.3)).all()


def test_the_response_of_pixels_is_divided_out(ramp):
    """Pixels of the raw frame are correlated with the response of the detector, and calibrated ones hardly are.

    sample: 37,000 pixels with a correlation of 0.2 in the raw frame; significance: both limits are at 4 sigma or more,
    with an error of 0.005. Interpixel capacitance leaves a correlation of -0.02.
    """
    check_response(ramp[0], "nisp", 0.12)


@pytest.mark.nightly
def test_the_response_of_a_ccd_is_divided_out(tmp_path):
    """sample: 37,000 pixels with a correlation of 0.1 in the raw frame; significance: both limits are at 8 sigma"""
    check_response(render(tmp_path, CCD)[0], "vis", 0.05)


def test_hot_pixels_of_a_ramp_give_no_detections(ramp, monkeypatch):
    """A mean of 1e-3 of the pixels are hot, 37 of 192 x 192.

    sample: 1 arcmin2 with 12 detections of hot pixels if nothing is known of them; significance: at 0.5 false
    detections per arcmin2, there are 4 or more with a probability of 0.2 %
    """
    frame, sources, noise_free = ramp
    for path in (noise_free, None):
        measured = frame_examples.measure(frame, sources, Settings(), noise_free=path)
        assert measured.conditions["unmatched"] < 4
        assert measured.examples.outcomes.detected.sum() == 2
    monkeypatch.setattr(ideal_masters, "ideal_masters", constant_masters)
    assert frame_examples.measure(frame, sources, Settings()).conditions["unmatched"] >= 8


def test_hot_pixels_are_those_whose_dark_current_exceeds_the_noise(ramp):
    frame = ramp[0]
    drawn = dark_map.EFFECT.apply(
        np.zeros((frame.scene.ny, frame.scene.nx)), *dark_map.EFFECT.parameters(frame.scene),
        rng=stream(SEED, "nisp", "DET22", dark_map.EFFECT.name),
    )  # fmt: skip
    masters = ideal_masters.ideal_masters(frame, 10.0)
    assert masters.dark.mean * frame.scene.exposure_time_s == pytest.approx(drawn, rel=1e-5, abs=0)
    is_hot = drawn - np.median(drawn) > 10.0
    assert ((masters.flags & HOT != 0) == is_hot).all()
    assert 15 <= is_hot.sum() <= 60


def test_bad_pixels_are_replaced_if_the_light_is_known(ramp):
    frame, _, noise_free = ramp
    image, _ = frame_examples._calibrate(frame, None)
    light = np.asarray(read_back.electrons(noise_free).data, float)
    is_bad = image.flags & (HOT | RESPONSE) != 0
    assert not image.weight[is_bad].any()
    replaced = frame_examples.replace_hits(image, light, 5.0, np.random.default_rng(1))
    assert replaced.weight[is_bad].all()
    assert not (replaced.flags[is_bad] & (HOT | RESPONSE)).any()
    noise = np.sqrt(1.0 / replaced.weight[is_bad] + light[is_bad])
    pull = (replaced.image - np.median(image.image) - light)[is_bad] / noise
    assert np.abs(pull).max() < 5.0
