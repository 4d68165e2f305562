"""Check the noise of blank sky and overscan against the header, and the gain from the noise of the sky.

Notes
-----
Counts of S electrons have the variance S, so S / (variance - read variance) is the gain over the gain in the header.
"""

from __future__ import annotations

import numpy as np

from truesky.validation.lake.measure import blank_sky, covariances
from truesky.validation.lake.measure.frame_context import RAMPS, FrameCheck, FrameContext, require_blank_sky
from truesky.validation.lake.measure.frames import Amplifier
from truesky.validation.lake.measure.rows import Row

SOURCE = "photon transfer (Janesick 2007); up the ramp: Kubik et al. 2016, PASP 128, 104504"
# Tolerances of the ratio of noises and of the ratio of gains.
_NOISE, _GAIN = 0.05, 0.015
# For ramps, capacitance between pixels removes 5 % of the noise, and stripes of the outputs add about the same.
_GAIN_OF_RAMPS = 0.06
# Up to this level (e-) the pixel response (1 % rms) contributes little noise, as its share grows with the level.
_MAX_LEVEL = 400.0
# Smallest number of pixels per amplifier for the gain.
_MIN_PIXELS = 60_000


def check(context: FrameContext) -> list[Row]:
    """Check the noise of the overscan and of blank sky, and the gain of each amplifier."""
    return [*_overscan_rows(context), *_sky_rows(context)]


def _overscan_rows(context: FrameContext) -> list[Row]:
    rows = []
    for amplifier in context.frame.amplifiers:
        # Without drawn read noise the overscan has rounding to whole ADU alone, which is not random.
        if amplifier.samples and np.isfinite(amplifier.noise) and amplifier.header_read_noise > 0.0:
            # The read noise in the header does not include rounding to whole ADU.
            expected = np.hypot(amplifier.header_read_noise, amplifier.gain / np.sqrt(12.0))
            value = amplifier.noise / expected
            error = value / np.sqrt(amplifier.samples)
            rows.append(
                Row(
                    "noise",
                    f"overscan{_suffix(amplifier)}",
                    context.place,
                    value,
                    error,
                    1.0,
                    _NOISE,
                    "",
                    SOURCE,
                    note=f"{amplifier.samples} pixels of the overscan, differences of neighbours",
                )
            )
    return rows


def _sky_rows(context: FrameContext) -> list[Row]:
    assert context.tiles is not None
    rows: list[Row] = []
    gains: list[tuple[float, float]] = []
    factor = ramp_factor(context) if context.channel in RAMPS else 1.0
    for amplifier in context.frame.amplifiers:
        tiles = context.tiles.in_amplifier(amplifier)
        if len(tiles.row) < 2:
            continue
        level = float(np.average(tiles.level, weights=tiles.blank.sum(axis=(1, 2))))
        pixels, base_variance = int(tiles.blank.sum()), read_variance(amplifier)
        if context.channel in RAMPS:
            value, error = blank_sky.variance(tiles)
        else:
            value, error = covariances.pixel_variance(tiles.pixels, tiles.blank, 0)
        # Pixel response is noise in a single frame, although not noise of the sky.
        base_variance += (context.frame.instrument.pixel_response_rms * level) ** 2
        expected = factor * level + base_variance
        note = f"{pixels} blank pixels in tiles of {blank_sky.SIDE}, level {level:.4g} e-"
        rows.append(Row("noise", f"sky{_suffix(amplifier)}", context.place, np.sqrt(value / expected),
                        0.5 * error / expected, 1.0, _NOISE, "", SOURCE, note=note))  # fmt: skip
        if pixels >= _MIN_PIXELS and level <= _MAX_LEVEL and value > base_variance:
            gain = factor * level / (value - base_variance)
            gains.append((gain, gain * error / (value - base_variance)))
            rows.append(
                Row(
                    "gain",
                    f"ratio{_suffix(amplifier)}",
                    context.place,
                    gain,
                    gain * error / (value - base_variance),
                    1.0,
                    _GAIN_OF_RAMPS if context.channel in RAMPS else _GAIN,
                    "",
                    SOURCE,
                    note=note,
                )
            )
        context.series.setdefault("noise", []).append((np.sqrt(expected), np.sqrt(value)))
    if len(gains) > 1:
        ratio, error = np.array(gains).T
        weight = 1.0 / error**2
        mean, mean_error = float((weight * ratio).sum() / weight.sum()), float(weight.sum() ** -0.5)
        note = f"{len(gains)} amplifiers"
        rows.append(Row("gain", "ratio", context.place, mean, mean_error, 1.0, _GAIN, "", SOURCE, note=note))
    return rows


def read_variance(amplifier: Amplifier) -> float:
    """Return the read variance per pixel in e-^2: measured in the overscan, or from the header if there is none."""
    if amplifier.samples and np.isfinite(amplifier.noise):
        return amplifier.noise**2
    return amplifier.header_read_noise**2 + amplifier.gain**2 / 12.0


def ramp_factor(context: FrameContext) -> float:
    """Return the variance of a ramp's signal over its electrons, without read noise; groups share photons."""
    groups, reads, drops = (int(context.frame.header[key]) for key in ("NG", "NR", "ND"))
    n, step = groups - 1, reads + drops
    alpha = (1.0 - reads**2) / (3.0 * reads * step)
    shared = (reads**2 - 1.0) / (6.0 * reads)
    return (n * step * (1.0 + alpha) + 2.0 * (n - 1) * shared) / (n * step)


def _suffix(amplifier: Amplifier) -> str:
    end = amplifier.name.rpartition(".")[2]
    return f"_{end}" if end and end != "SCI" else ""


NOISE = FrameCheck("noise", SOURCE, require_blank_sky, check)
