"""Check the noise of blank sky and of the overscan against the header, and measure the gain from the noise of the sky.

Notes
-----
A signal of S electrons has the variance S. If the header has a wrong gain, S / (variance - read variance) is the true
gain divided by the gain in the header.
"""

from __future__ import annotations

import numpy as np

from truesky.validation.lake.measure import blank_sky, covariances
from truesky.validation.lake.measure.frame_context import RAMPS, FrameCheck, FrameContext, require_blank_sky
from truesky.validation.lake.measure.frames import Amplifier
from truesky.validation.lake.measure.rows import Row

SOURCE = "photon transfer (Janesick 2007); up the ramp: Kubik et al. 2016, PASP 128, 104504"
# Tolerance of the measured noise divided by the expected noise, which should be 1.
_NOISE = 0.05
# Tolerance of the measured gain divided by the gain in the header, which should be 1.
_GAIN = 0.015
# Tolerance of the gain of infrared detectors. Capacitance between pixels removes 5 % of the noise, and stripes of the
# output amplifiers add about the same.
_GAIN_OF_RAMPS = 0.06
# The gain is not measured if the sky level is above this value, e-: differences in the response of pixels (1 % rms)
# then add too much to the noise.
_MAX_LEVEL = 400.0
# The gain of an amplifier with fewer pixels of blank sky than this number is not measured.
_MIN_PIXELS = 60_000


def check(context: FrameContext) -> list[Row]:
    """Check the noise of the overscan and of blank sky, and the gain, for each amplifier of a frame.

    Returns rows (measured value divided by the value expected from the header, with verdict). Amplifiers without
    overscan or with fewer than two blank tiles are left out.
    """
    return [*_overscan_rows(context), *_sky_rows(context)]


def _overscan_rows(context: FrameContext) -> list[Row]:
    rows = []
    for amplifier in context.frame.amplifiers:
        # Skip amplifiers whose read noise the request switches off: all pixels of their overscan have nearly the same
        # whole number.
        if amplifier.samples and np.isfinite(amplifier.noise) and amplifier.overscan_read_noise > 0.0:
            # Add the noise of rounding to whole ADU, which the read noise in the header does not include.
            expected = np.hypot(amplifier.overscan_read_noise, amplifier.gain / np.sqrt(12.0))
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
        # Add the pixel response to the variance: in a single frame it cannot be separated from noise.
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
    """Return the variance of a pixel without light in e-^2, from read noise and rounding to whole ADU.

    It is measured in the overscan, or computed from the header if the amplifier has no overscan, or if read noise is
    left out in the pixels, which the overscan always has.
    """
    if amplifier.samples and amplifier.header_read_noise > 0.0 and np.isfinite(amplifier.noise):
        return amplifier.noise**2
    return amplifier.header_read_noise**2 + amplifier.gain**2 / 12.0


def ramp_factor(context: FrameContext) -> float:
    """Return the photon noise of the signal of an infrared ramp: its variance divided by its number of electrons.

    The ratio differs from 1 because reads of the ramp are averaged in groups. It depends on the readout mode in the
    header (NG groups of NR reads with ND dropped reads between them). Read noise is not included.
    """
    groups, reads, drops = (int(context.frame.header[key]) for key in ("NG", "NR", "ND"))
    n, step = groups - 1, reads + drops
    alpha = (1.0 - reads**2) / (3.0 * reads * step)
    shared = (reads**2 - 1.0) / (6.0 * reads)
    return (n * step * (1.0 + alpha) + 2.0 * (n - 1) * shared) / (n * step)


def _suffix(amplifier: Amplifier) -> str:
    end = amplifier.name.rpartition(".")[2]
    return f"_{end}" if end and end != "SCI" else ""


NOISE = FrameCheck("noise", SOURCE, require_blank_sky, check)
