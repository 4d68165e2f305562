"""A faulty frame is detected by comparison with other frames, although each alone looks correct."""

import numpy as np

from truesky.validation.lake.images import repeatability
from truesky.validation.lake.measure.frame_context import Result
from truesky.validation.lake.measure.rows import Place
from truesky.validation.verdicts import FAIL, NOT_APPLICABLE, PASS


def frame(number, rng, east=0.0, mag=0.0, first=0, n=60):
    """n stars with offsets of 0.5 mas rms."""
    ids = np.arange(first, first + n)
    series = {
        "id": ids, "east": east + 0.5 * rng.standard_normal(n), "north": 0.5 * rng.standard_normal(n),
        "measured": 20.0 + 0.01 * ids + mag + 0.005 * rng.standard_normal(n),
    }  # fmt: skip
    return Result(Place("VIS", "euclid_vis", number, "1-1"), [], series)


def verdicts(frames):
    return {(row.place.exposure_id, row.quantity): row.verdict for row in repeatability.rows(frames)}


def test_frames_that_agree():
    rng = np.random.default_rng(1)
    found = verdicts([frame(number, rng) for number in (1, 2, 3)])
    assert set(found.values()) == {PASS}
    assert len(found) == 6


def test_the_frame_that_is_off():
    rng = np.random.default_rng(1)
    found = verdicts([frame(1, rng), frame(2, rng, east=10.0), frame(3, rng, east=10.0, mag=0.05)])
    assert found[2, "east"] == FAIL
    assert found[2, "north"] == found[2, "magnitude"] == found[3, "east"] == PASS
    assert found[3, "magnitude"] == FAIL


def test_frames_without_common_stars():
    rng = np.random.default_rng(1)
    (row,) = repeatability.rows([frame(1, rng), frame(2, rng, first=1000)])
    assert row.verdict == NOT_APPLICABLE
