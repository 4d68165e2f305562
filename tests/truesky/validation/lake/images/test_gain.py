"""The gain from two frames with different pixel response agrees with the gain of the frames."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.ndimage

from lake_schema.tables.rendered_truth import RENDERED_TRUTH
from tests.truesky import nightly
from tests.truesky.validation.lake import made
from truesky.validation.lake.images.gain import GAIN
from truesky.validation.lake.images.noise import NOISE
from truesky.validation.lake.measure import frame_context, references
from truesky.validation.lake.measure.rows import Place
from truesky.validation.lake.suite import inventory
from truesky.validation.verdicts import FAIL, NOT_APPLICABLE, PASS

SIDE = 2 * made.SIDE


def empty():
    nothing = references.load_catalogue({}, np.zeros(0, np.int64), ())
    return references.build_reference(RENDERED_TRUTH.empty(), nothing, "euclid_vis", 6e4)


def pair(folder, levels=(350.0, 300.0), told=made.GAIN, sharing=0.0, response=0.03):
    """A frame with 3 % pixel response and fringes; sharing is the fraction of charge that goes to each side."""
    rng = np.random.default_rng(11)
    own = 1.0 + response * rng.standard_normal((SIDE, SIDE))
    across = np.arange(SIDE)
    waves = 1.0 + 0.01 * np.sin(2 * np.pi * (across + 0.4 * across[:, None]) / 60.0)
    kernel = np.array([[0, sharing, 0], [sharing, 1 - 4 * sharing, sharing], [0, sharing, 0]])
    paths = []
    for n, level in enumerate(levels):
        counted = rng.poisson(level * own * (waves if n else 1.0)).astype(float)
        shared = scipy.ndimage.convolve(counted, kernel, mode="reflect")
        path = folder / f"{n}.fits"
        # The sky is flat enough that charge sharing does not change the level.
        paths.append(made.vis_file(path, shared, rng, told=told))
    of = frame_context.measure_frame(paths[0], Place("EXT", "des_g", 2, "N4"), empty())
    of.partner = frame_context.PartnerFrame(paths[1], 1, empty())
    return of


def rows(of):
    return {row.quantity: row for row in GAIN.run(of)}


@nightly.parametrize("sharing", [0.0, 0.005], (1,))
def test_pixel_response_cancels_in_two_frames(tmp_path, sharing):
    found = rows(pair(tmp_path, sharing=sharing))
    assert found["pair"].value == pytest.approx(1.0, abs=4.0 * found["pair"].error)
    assert found["pair"].error < 0.008
    assert found["pair"].verdict == PASS
    assert {f"pair_{quadrant}" for quadrant in "EFGH"} < set(found)


def test_pixel_response_misleads_a_single_frame(tmp_path):
    single = {row.quantity: row for row in NOISE.run(pair(tmp_path)) if row.check == "gain"}
    assert single["ratio"].value < 0.9


@nightly.parametrize("wrong", [0.955, 1.045], (1,))
def test_a_gain_that_is_off(tmp_path, wrong):
    assert rows(pair(tmp_path, told=wrong * made.GAIN))["pair"].verdict == FAIL


def test_frames_of_too_different_levels(tmp_path):
    of = pair(tmp_path, levels=(3500.0, 50.0))
    assert {row.verdict for row in GAIN.run(of)} == {NOT_APPLICABLE}
    of = pair(tmp_path, levels=(350.0, 300.0))
    lit = replace(of, frame=replace(of.frame, header={**of.frame.header, "IMAGETYP": "flat"}))
    assert {row.verdict for row in GAIN.run(lit)} == {NOT_APPLICABLE}
    assert {row.verdict for row in GAIN.run(replace(of, partner=None))} == {NOT_APPLICABLE}


def shot(number, band, image_type="science", channel="EXT", sky=10.0, lamp=None):
    exposure = {"camera": "decam", "image_type": image_type, "sky": sky, "exposure_time_s": 90.0, "lamp": lamp}
    return inventory.ScienceFile(f"{number}.fits", Place(channel, band, number, "N4"), exposure)


def test_choice_of_frame_pairs():
    """Pairs prefer one band, then similar levels; flats need the same lamp; sky frames of VIS have no partner."""
    bands = [
        shot(1, "des_g", sky=3.0),
        shot(2, "des_r", sky=9.0),
        shot(3, "des_z", sky=30.0),
        shot(4, "des_i", sky=11.0),
    ]
    assert {path: other.path for path, other in inventory.gain_partners(bands).items()} == {"4.fits": "2.fits"}
    again = [*bands, shot(5, "des_g", sky=20.0)]
    assert {path: other.path for path, other in inventory.gain_partners(again).items()} == {"5.fits": "1.fits"}
    flats = [shot(n, "euclid_h", "flat", "NISP-P", lamp=lamp) for n, lamp in ((1, 1), (2, 2), (3, 1), (4, 2), (5, 3))]
    assert {path: other.path for path, other in inventory.gain_partners(flats).items()} == {
        "3.fits": "1.fits",
        "4.fits": "2.fits",
    }
    assert not inventory.gain_partners([shot(n, "euclid_vis", channel="VIS") for n in (1, 2)])
