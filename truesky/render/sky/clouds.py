"""Grey extinction by thin clouds that drift over the telescope, so that the extinction changes during an exposure.

The extinction is the same over the field of view and at all wavelengths. Clouds do not change the sky background.
"""

from __future__ import annotations

import numpy as np

from truesky.randomness import rng

_DAY_S = 86400.0
# Shortest and longest period of the waves of which the drift consists, in seconds, and their number. Assumed: clouds
# cross a field of view in minutes and come and go within hours.
_PERIODS, _WAVES = (120.0, 7200.0), 12
# Rms of the extinction relative to its mean. Assumed.
_SCATTER = 0.3
# Number of instants of an exposure over which the transmission is averaged.
_INSTANTS = 64


def extinction(mean: float, mjd: float, seconds: float, longitude: float, seed: int) -> float:
    """Return the extinction of an exposure in magnitudes, from the mean of its transmission.

    Parameters
    ----------
    mean : float
        Mean extinction of the night in magnitudes; 0 for a clear night.
    mjd : float
        Start of the exposure.
    seconds : float
        Exposure time in seconds.
    longitude : float
        Longitude of the observatory, deg east. All exposures between two local noons have the same clouds.
    seed : int
        Seed of the request, which selects the drift.

    Returns
    -------
    float
        Magnitudes, 0 or more. The mean over a night is about `mean`.

    Notes
    -----
    The extinction k(t) is `mean` times 1 plus a sum of sine waves with random phases and amplitudes that grow with the
    square root of their periods. The result is -2.5 log10 of the mean of 10^(-0.4 k) over the exposure.
    """
    if mean == 0.0:
        return 0.0
    noon = float(np.floor(mjd + longitude / 360.0 - 0.5)) + 0.5 - longitude / 360.0
    phases = rng.stream(seed, "exposures.clouds", round(noon * 2.0)).uniform(0.0, 2.0 * np.pi, _WAVES)
    periods = np.geomspace(*_PERIODS, _WAVES)
    amplitudes = np.sqrt(periods)
    amplitudes *= _SCATTER * np.sqrt(2.0 / np.sum(amplitudes**2))
    times = (mjd - noon) * _DAY_S + seconds * (np.arange(_INSTANTS) + 0.5) / _INSTANTS
    waves = np.sin(2.0 * np.pi * times[:, None] / periods + phases)
    at_times = mean * np.maximum(1.0 + (waves * amplitudes).sum(axis=1), 0.0)
    return float(-2.5 * np.log10(np.mean(10.0 ** (-0.4 * at_times))))
