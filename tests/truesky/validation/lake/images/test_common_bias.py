"""A bias that is too small to detect on one detector is detected in the mean of several."""

import numpy as np
import pytest

from truesky.validation.lake.images import common_bias
from truesky.validation.lake.measure.frame_context import Result
from truesky.validation.lake.measure.rows import Place
from truesky.validation.verdicts import FAIL, NOT_APPLICABLE, PASS, UNDECIDED, verdict


def detectors(rng, east=0.0, mag=0.0, exposures=(1,), n=36):
    """Offsets of 1 mas and 0.01 mag rms, equal to their errors."""
    out = []
    for number in exposures:
        for detector in range(n):
            off = np.array([[east + rng.standard_normal(), 1.0], [rng.standard_normal(), 1.0]])
            dm = np.array([mag + 0.01 * rng.standard_normal(), 0.01])
            place = Place("VIS", "euclid_vis", number, str(detector))
            out.append(Result(place, [], {"mean_off": off, "mean_dm": dm}))
    return out


def verdicts(results):
    return {(row.place.exposure_id, row.quantity): row.verdict for row in common_bias.rows(results)}


def test_detectors_without_a_bias():
    found = verdicts(detectors(np.random.default_rng(1), exposures=(1, 2)))
    assert set(found.values()) == {PASS}
    assert set(found) == {(at, name) for at in (1, 2, None) for name in ("east", "north", "magnitude")}


def test_a_bias_that_all_detectors_share():
    """A bias of 2 mas and of 0.03 mag is not detectable on a single detector."""
    assert verdict(2.0, 1.0, 0.0, 1.0) == verdict(0.03, 0.01, 0.0, 0.02) == UNDECIDED
    found = verdicts(detectors(np.random.default_rng(1), east=2.0, mag=0.03))
    assert found == {(1, "east"): FAIL, (1, "north"): PASS, (1, "magnitude"): FAIL}


def test_scatter_between_detectors_widens_the_error():
    """The error of the mean includes scatter beyond the single errors."""
    rng = np.random.default_rng(2)
    values = 5.0 * rng.standard_normal(400)
    mean, error = common_bias.weighted_mean(values, np.full(400, 0.1))
    assert error == pytest.approx(0.25, rel=0.1)
    assert abs(mean) < 4.0 * error


def test_one_detector_is_not_averaged():
    (row,) = common_bias.rows(detectors(np.random.default_rng(1), n=1))
    assert row.verdict == NOT_APPLICABLE
    assert row.note
