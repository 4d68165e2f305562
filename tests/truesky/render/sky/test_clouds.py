"""Extinction by drifting clouds: mean and drift, and the mean transmission of an exposure."""

import numpy as np
import pytest

from truesky.render.sky import clouds

LONGITUDE = -70.7


def test_a_clear_sky_has_no_extinction():
    assert clouds.extinction(0.0, 60990.2, 30.0, LONGITUDE, 1) == 0.0


def test_extinction_drifts_about_its_mean():
    """Mean and scatter over 60 nights of 40 exposures: 0.3 times the mean, which half of the waves share in a night."""
    found = np.array(
        [[clouds.extinction(0.5, 60990.1 + n + i / 200.0, 30.0, LONGITUDE, 7) for i in range(40)] for n in range(60)]
    )
    assert found.mean() == pytest.approx(0.5, abs=0.03)
    assert found.std() == pytest.approx(0.15, abs=0.03)
    assert found.min() >= 0.0
    # The drift is continuous: half a minute changes less than half an hour.
    steps = np.array([clouds.extinction(0.5, 60990.1 + i * 30.0 / 86400.0, 1.0, LONGITUDE, 7) for i in range(120)])
    assert np.abs(np.diff(steps)).mean() < 0.5 * np.abs(steps[60:] - steps[:60]).mean()


def test_a_long_exposure_has_the_mean_transmission_of_its_parts():
    parts = [clouds.extinction(0.8, 60990.1 + i * 10.0 / 86400.0, 10.0, LONGITUDE, 3) for i in range(60)]
    whole = clouds.extinction(0.8, 60990.1, 600.0, LONGITUDE, 3)
    assert whole == pytest.approx(-2.5 * np.log10(np.mean(10.0 ** (-0.4 * np.array(parts)))), abs=2e-3)
    assert whole == clouds.extinction(0.8, 60990.1, 600.0, LONGITUDE, 3)
    assert whole != clouds.extinction(0.8, 60990.1, 600.0, LONGITUDE, 4)
