"""Small samples of examples and models for the tests of the emulator."""

import numpy as np

from truesky.emulator import model
from truesky.emulator.examples import Examples, Outcomes
from truesky.emulator.features import Features

FACTS = {
    "camera": "vis", "band": "euclid_vis", "faintest": 1.5, "frames": 2, "code": "0",
    "settings": {"threshold": 1.5, "pixels": 5, "aperture_fwhm": 3.0},
    "conditions": {"depth": [26.0, 26.4], "sky": [0.2, 0.3], "psf_area": [0.12, 0.13]},
}  # fmt: skip


def features(n, seed, faintest=1.5):
    """Return features of n sources, of which a tenth are points."""
    rng = np.random.default_rng(seed)
    is_point = rng.random(n) < 0.1
    brightness = np.maximum(faintest - rng.exponential(1.5, n), -8.5)
    width = np.where(is_point, 0.0, np.clip(rng.normal(0.35, 0.15, n), 0.0, 1.2))
    return Features(brightness, width, np.clip(rng.normal(-2.0, 1.0, n), -2.0, 2.0), is_point)


def probability(found):
    """Return the detection probability of the made-up survey: it falls with brightness and width."""
    return 1.0 / (1.0 + np.exp(4.0 * (found.brightness + found.width)))


def examples(n=4000, seed=1, offset=0.0):
    """Return examples of a made-up survey, whose magnitude errors grow with the brightness."""
    found, rng = features(n, seed), np.random.default_rng(seed + 1)
    detected = rng.random(n) < probability(found)
    error = 0.2 * 10.0 ** (0.3 * found.brightness)

    def measured(values):
        return np.where(detected, values, np.nan).astype(np.float32)

    return Examples(
        found,
        Outcomes(
            detected, ~detected & (rng.random(n) < 0.1), measured(offset + error * rng.normal(0.0, 1.0, n)),
            measured(error), measured(error * rng.normal(0.0, 1.0, n)), measured(error),
            measured(1.0 + error * rng.normal(0.0, 0.1, n)), measured(error * rng.normal(0.0, 1.0, n)),
            measured(error * rng.normal(0.0, 1.0, n)), np.where(detected, 2, 0).astype(np.int16),
        ),
    )  # fmt: skip


def write(path, n=4000, seed=1, offset=0.0, **facts):
    """Write a model file and return its path."""
    model.write_model(path, examples(n, seed, offset), {**FACTS, **facts})
    return path
