"""Test how true sources are matched with detections."""

import numpy as np

from truesky.emulator import matching


def segments(*boxes):
    """Return a map of 60 x 60 pixels in which boxes (first row, last row, first column, last column) are detections."""
    out = np.zeros((60, 60), np.int32)
    for number, (top, bottom, left, right) in enumerate(boxes, 1):
        out[top : bottom + 1, left : right + 1] = number
    return out


def test_the_source_with_more_light_claims_a_detection_and_the_other_is_blended():
    found = matching.match(
        np.array([20.0, 23.0, 50.0]), np.array([20.0, 20.0, 50.0]), np.array([1.0, 5.0, 9.0]), np.full(3, 2.0),
        segments((16, 24, 16, 27)),
    )  # fmt: skip
    assert list(found.detection) == [-1, 0, -1]
    assert list(found.is_blended) == [True, False, False]


def test_a_faint_source_outside_the_pixels_of_a_near_bright_one_does_not_claim_it():
    """A match by distance alone would give the detection to either source."""
    found = matching.match(
        np.array([20.0, 26.0]), np.array([20.0, 20.0]), np.array([100.0, 1.0]), np.array([2.0, 2.0]),
        segments((17, 23, 17, 22)),
    )  # fmt: skip
    assert list(found.detection) == [0, -1]
    assert not found.is_blended.any()


def test_a_source_takes_the_detection_with_most_of_its_light():
    found = matching.match(
        np.array([20.0]),
        np.array([20.0]),
        np.array([1.0]),
        np.array([4.0]),
        segments((18, 22, 16, 18), (18, 22, 19, 24)),
    )
    assert list(found.detection) == [1]


def test_sources_beyond_the_edge_and_empty_images():
    nothing = matching.match(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0), segments())
    assert nothing.detection.size == 0
    found = matching.match(
        np.array([-5.0, 62.0]), np.array([10.0, 10.0]), np.ones(2), np.full(2, 9.0), segments((0, 59, 0, 59))
    )
    assert list(found.detection) == [0, -1] or list(found.detection) == [-1, 0]
