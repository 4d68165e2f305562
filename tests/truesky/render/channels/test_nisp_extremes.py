"""NISP-P at the extremes: the brightest star, a frame of full pixels, a hundred thousand sources."""

import tracemalloc

import numpy as np
import pytest

from lake_schema.mission.configuration import resolve
from tests.truesky import nightly
from tests.truesky.render import infrared
from tests.truesky.render.fields import small
from truesky.render.products import headers
from truesky.request.accuracy import DRAFT, SURVEY


def flag(found):
    return found.readout.extensions[1].data[4:-4, 4:-4]


def test_a_star_of_ab_0():
    """Pixels in the middle are full at the first read and have no signal. Pixels that fill up later are flagged."""
    found = infrared.rendered(
        [0.0], [100.0], [100.0], detector=small("nisp", "DET22", 400), accuracy=DRAFT, truth=("saturation",)
    )
    full, signal = found.maps["saturation"] == 1, infrared.electrons(found)
    distance = np.hypot(*(np.indices(full.shape) - 100.0))
    assert full[distance < 40.0].all()
    assert not full[distance > 300.0].all()
    # These pixels are full at the first read, so the groups differ only by the noise of the reads.
    assert np.abs(signal[distance < 2.0]).max() < 60.0
    # These pixels become full between two groups, so the ramp does not fit.
    between = full & (signal > 1e4)
    assert between.sum() > 500
    assert flag(found)[between].mean() > 0.95
    assert np.isfinite(found.noise_free).all()


@nightly.parametrize(
    ("choice", "off", "error"), [(0.0, (), 0.02), (1.0, (), 5e-3), (0.0, ("ramp_nonlinearity",), 5e-3)], (1,)
)
def test_the_level_of_saturation(choice, off, error):
    """A pixel that is full at the end of the ramp has the signal SATURATE.

    If it is full earlier, its ramp does not fit.
    """
    quiet = dict.fromkeys(("ramp_cosmic_rays", "dark_map", "pixel_response", "output_gain", "ipc"), False)
    quiet |= dict.fromkeys(off, False)
    own = resolve(overrides={"nisp.nonlinearity_spread": (0.0, ""), "nisp.nonlinearity_of_signal": (choice, "")})
    signals, flags = {}, {}
    for part in (0.1, 1.0, 1.5):
        found = infrared.rendered(sky=part * 1.3e5 / (76 * 1.454), forced=quiet, mission=own)
        signals[part], flags[part] = np.median(found.science), flag(found).mean()
    level = dict((key, value) for key, value, _ in headers.science_cards(found))["SATURATE"]
    # Non-linearity of the ramp adds to the mean of its squared differences.
    assert signals[1.0] == pytest.approx(level, rel=error)
    assert flags[0.1] < 0.01
    assert flags[1.5] == 1.0
    assert signals[1.5] > level


@pytest.mark.parametrize("count", [5_000, pytest.param(100_000, marks=pytest.mark.nightly)])
def test_memory_does_not_grow_with_the_sources(count):
    """The peak memory is at most 160 bytes per pixel and 4 kB per source, in addition to 100 MB.

    The short test has fewer pixels with the same density of sources.
    """
    side = 2040 if count > 50_000 else 456
    rng = np.random.default_rng(1)
    x, y, mags = rng.uniform(0, side, count), rng.uniform(0, side, count), rng.uniform(20.0, 25.0, count)
    detector = small("nisp", "DET22", side)
    infrared.rendered(mags[:10], x[:10], y[:10], detector=detector)
    tracemalloc.start()
    try:
        found = infrared.rendered(mags, x, y, detector=detector, accuracy=SURVEY)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(found.sources) == count
    assert peak < 160 * side**2 + 4_000 * count + 1e8
