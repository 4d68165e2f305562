"""Noise of blank sky and of the overscan against what the header foresees; the gain that the sky's own noise tells.

Counts of S electrons have the variance S, so S / (variance - that of reading) is the gain over the header's.
"""

from __future__ import annotations

import numpy as np

from truesky.validation.lake.measure import blank, covariances
from truesky.validation.lake.measure.frames import Amplifier
from truesky.validation.lake.measure.rows import Row
from truesky.validation.lake.measure.seen import RAMPS, Check, Seen, wants_blank

SOURCE = "photon transfer (Janesick 2007); up the ramp: Kubik et al. 2016, PASP 128, 104504"
# Of the ratio of noises, of the ratio of gains.
_NOISE, _GAIN = 0.05, 0.015
# Capacitance between pixels takes 5 % of the noise, stripes of the outputs bring about as much.
_GAIN_OF_RAMPS = 0.06
# Levels up to which the sensor's response, which grows with the level, is no part of the noise: its share of 1 % rms.
_MOST_LEVEL = 400.0
# Pixels that an amplifier's gain wants.
_LEAST_PIXELS = 60_000


def check(of: Seen) -> list[Row]:
    """Of the overscan and of blank sky, and the gain of each amplifier."""
    return [*_overscans(of), *_sky(of)]


def _overscans(of: Seen) -> list[Row]:
    rows = []
    for amplifier in of.frame.amplifiers:
        # Where no read noise is drawn, rounding to whole ADU is all there is, and no random number.
        if amplifier.samples and np.isfinite(amplifier.noise) and amplifier.told > 0.0:
            # A header's read noise is without rounding to whole ADU.
            own = np.hypot(amplifier.told, amplifier.gain / np.sqrt(12.0))
            value = amplifier.noise / own
            error = value / np.sqrt(amplifier.samples)
            rows.append(Row("noise", f"overscan{_name(amplifier)}", of.place, value, error, 1.0, _NOISE, "", SOURCE,
                            note=f"{amplifier.samples} pixels of the overscan, differences of neighbours"))  # fmt: skip
    return rows


def _sky(of: Seen) -> list[Row]:
    assert of.tiles is not None
    rows: list[Row] = []
    gains: list[tuple[float, float]] = []
    factor = ramp_factor(of) if of.channel in RAMPS else 1.0
    for amplifier in of.frame.amplifiers:
        own = of.tiles.of(amplifier)
        if len(own.row) < 2:
            continue
        level = float(np.average(own.level, weights=own.blank.sum(axis=(1, 2))))
        pixels, read = int(own.blank.sum()), reading(amplifier)
        if of.channel in RAMPS:
            value, error = blank.variance(own)
        else:
            value, error = covariances.own_variance(own.pixels, own.blank, 0)
        # Pixels differ in what they make of the same light: noise of one frame, if not of the sky.
        read += (of.frame.instrument.response * level) ** 2
        told = factor * level + read
        note = f"{pixels} blank pixels in tiles of {blank.SIDE}, level {level:.4g} e-"
        rows.append(Row("noise", f"sky{_name(amplifier)}", of.place, np.sqrt(value / told),
                        0.5 * error / told, 1.0, _NOISE, "", SOURCE, note=note))  # fmt: skip
        if pixels >= _LEAST_PIXELS and level <= _MOST_LEVEL and value > read:
            gain = factor * level / (value - read)
            gains.append((gain, gain * error / (value - read)))
            rows.append(Row("gain", f"ratio{_name(amplifier)}", of.place, gain, gain * error / (value - read),
                            1.0, _GAIN_OF_RAMPS if of.channel in RAMPS else _GAIN, "", SOURCE, note=note))  # fmt: skip
        of.series.setdefault("noise", []).append((np.sqrt(told), np.sqrt(value)))
    if len(gains) > 1:
        ratio, error = np.array(gains).T
        weight = 1.0 / error**2
        mean, its = float((weight * ratio).sum() / weight.sum()), float(weight.sum() ** -0.5)
        note = f"{len(gains)} amplifiers"
        rows.append(Row("gain", "ratio", of.place, mean, its, 1.0, _GAIN, "", SOURCE, note=note))
    return rows


def reading(amplifier: Amplifier) -> float:
    """Variance of reading a pixel, e-^2: measured where there is an overscan, else as the header has it."""
    if amplifier.samples and np.isfinite(amplifier.noise):
        return amplifier.noise**2
    return amplifier.told**2 + amplifier.gain**2 / 12.0


def ramp_factor(of: Seen) -> float:
    """Variance of a ramp's signal over its electrons, without reading: groups share some of their photons."""
    groups, reads, drops = (int(of.frame.header[key]) for key in ("NG", "NR", "ND"))
    n, step = groups - 1, reads + drops
    alpha = (1.0 - reads**2) / (3.0 * reads * step)
    shared = (reads**2 - 1.0) / (6.0 * reads)
    return (n * step * (1.0 + alpha) + 2.0 * (n - 1) * shared) / (n * step)


def _name(amplifier: Amplifier) -> str:
    end = amplifier.name.rpartition(".")[2]
    return f"_{end}" if end and end != "SCI" else ""


NOISE = Check("noise", SOURCE, wants_blank, check)
