"""Calibration by an observer: master biases and flats from frames, and the residuals of a science frame."""

from functools import cache

import numpy as np
import pytest

from tests.truesky.render import calibrated, nominal
from tests.truesky.render.fields import small
from truesky.render.effects.light import calibration_lamp, illumination, pixel_area
from truesky.render.effects.readout import nonlinearity, quadrants
from truesky.render.products import headers

FRAMES, BLOCK = 20, 64


def raw(detector, kind, number, seconds, sky=nominal.SKY, forced=None):
    """Return the quadrants with overscan, in electrons above the mean of the overscan, and the exposure."""
    sky = 0.0 if kind == "bias" else sky
    one = nominal.rendered(
        detector, [], [], [], kind=kind, number=number, seconds=seconds, sky=sky, forced=forced, truth=("cosmic_rays",)
    )
    gain = np.reshape(one.scene.amplifier_values("gain", "electron / adu"), (-1, 1, 1))
    # The second half of the overscan is free of deferred charge.
    level = one.raw[:, :-20, -14:].mean(axis=(1, 2), keepdims=True)
    return ((one.raw - level) * gain).astype(np.float32), one


def combined(frames):
    """Return the mean of values within four standard deviations of the median, which excludes cosmic rays."""
    stack = np.stack(frames)
    middle = np.median(stack, axis=0)
    spread = 1.4826 * np.median(np.abs(stack - middle), axis=0)
    kept = np.abs(stack - middle) <= 4.0 * np.maximum(spread, 1.0)
    return np.where(kept, stack, 0.0).sum(axis=0) / kept.sum(axis=0)


def linearised(frame, one):
    electrons = nonlinearity.linearise(frame.astype(float), *nonlinearity.EFFECT.parameters(one.scene))
    return quadrants.assemble(electrons, *quadrants.overscan_sizes(one.scene))


@cache
def masters(detector):
    """Return the master bias (quadrants), and the master flat [ny, nx] with mean 1."""
    bias = combined([raw(detector, "bias", i, 0.0)[0] for i in range(1, FRAMES + 1)])
    flats = []
    for i in range(1, FRAMES + 1):
        frame, one = raw(detector, "flat", 100 + i, 10.0)
        # The light of the sky through the open shutter is known. The unevenness of the lamp is divided out below.
        flats.append((linearised(frame - bias, one) - one.scene.sky_electrons).astype(np.float32))
    level, *pattern = calibration_lamp.EFFECT.parameters(one.scene)
    return bias, combined(flats) / (level * illumination.apply(np.ones(flats[0].shape), *pattern))


def calibrated_science(detector, sky, number, rays=False):
    """Return a calibrated science frame, NaN in spoilt pixels, and the expected electrons [ny, nx]."""
    bias, flat = masters(detector)
    forced = None if rays else nominal.off(*nominal.COSMIC_RAYS)
    frame, one = raw(detector, "science", 200 + number, nominal.TIME, sky, forced)
    found = linearised(frame - bias, one) / np.where(flat > 0.7, flat, np.nan)
    expected = np.full(found.shape, one.scene.sky_electrons)
    # Only effects in the header act on the image.
    applied = {decision.name for decision in one.decisions if decision.applied}
    for part in (pixel_area.EFFECT, illumination.EFFECT, illumination.SHUTTER):
        if part.name in applied:
            expected = part.apply(expected, *part.parameters(one.scene))
    # The header gives the dark current, or 0 if it is negligible.
    (dark,) = (value for keyword, value, _ in headers.science_cards(one) if keyword == "DARKRATE")
    expected += dark * nominal.TIME
    if rays:
        found = calibrated.without_hits(found, one.maps["cosmic_rays"])
    # Hot pixels are known from darks.
    return np.where(found > expected + 10 * np.sqrt(expected), np.nan, found), expected


def block_means(values):
    ny, nx = (n // BLOCK for n in values.shape)
    return np.nanmean(values[: ny * BLOCK, : nx * BLOCK].reshape(ny, BLOCK, nx, BLOCK), axis=(1, 3))


def check(detector):
    """Check that every block of 64 pixels is within 0.3 % of its expected level.

    At the nominal sky, shot and read noise scatter the blocks of one frame by 0.14 %, and the largest of 256 deviations
    is three times larger. The mean of four dithers has half this noise, so that errors of the calibration are visible.
    At a bright sky, one frame is enough. Cosmic rays leave half of a block, so one frame at the nominal sky shows only
    noise.
    """
    for sky, frames, rays in ((nominal.SKY, 4, False), (9.0, 1, False), (nominal.SKY, 1, True), (9.0, 1, True)):
        taken = [calibrated_science(detector, sky, number, rays) for number in range(frames)]
        expected = taken[0][1]
        left = np.mean([block_means(found - wanted) / block_means(wanted) for found, wanted in taken], axis=0)
        scatter = max(np.nanstd(found - wanted) / np.sqrt(wanted.mean()) for found, wanted in taken)
        print(f"{expected.mean():.0f} e-: blocks mean {left.mean():.5f}, rms {left.std():.5f}, "
              f"largest {np.abs(left).max():.5f}; scatter {scatter:.4f} of shot noise")  # fmt: skip
        assert np.sqrt(np.mean(left**2)) < 0.003
        assert np.abs(left).max() < 0.003 or (rays and sky == nominal.SKY)
        assert scatter <= 1.1


@pytest.mark.nightly
def test_masters_calibrate_a_science_frame():
    check(small("vis", "3-4", 256))


@pytest.mark.nightly
def test_masters_calibrate_a_sixteenth_of_a_detector():
    check(small("vis", "1-1", 1024))
