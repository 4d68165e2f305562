"""Check the gain with the difference of two frames of a detector, which is free of the pixel response.

Notes
-----
A signal of S electrons has the variance S. Charge sharing between neighbouring pixels (by capacitance, or because full
pixels repel charge) moves part of this variance to covariances with neighbours, so variance and covariances are added.
Offsets of rows or columns and gradients also cause covariances. They are measured at larger distances and subtracted.

References
----------
Janesick 2007, Photon Transfer
Antilogus et al. 2014, JINST 9, C03048
Moore et al. 2006, Opt. Eng. 45, 076402
"""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Bool
from truesky.validation.lake.images.noise import ramp_factor, read_variance
from truesky.validation.lake.measure import blank_sky, covariances, frames
from truesky.validation.lake.measure.blank_sky import Tiles
from truesky.validation.lake.measure.frame_context import RAMPS, FrameCheck, FrameContext
from truesky.validation.lake.measure.frames import Amplifier, Frame
from truesky.validation.lake.measure.references import Reference
from truesky.validation.lake.measure.rows import Row, not_applicable

SOURCE = "photon transfer of two frames (Janesick 2007); covariances: Antilogus et al. 2014, JINST 9, C03048"
# Tolerance of the measured gain divided by the gain in the header, which should be 1.
TOLERANCE = 0.015
# Distance, in pixels, over which neighbouring pixels share charge in frames of the sky.
_SKY_REACH = 1
# Distance, in pixels, over which neighbouring pixels share charge in frames with a level above _BRIGHT_LEVEL.
_BRIGHT_REACH = 2
# Level, in electrons, above which pixels share charge over _BRIGHT_REACH instead of _SKY_REACH pixels.
_BRIGHT_LEVEL = 5000.0
# The gain is measured from the difference of two frames of the sky only if the ratio of their signal levels is at most
# this value.
_MAX_SKY_RATIO = 30.0
# The gain is measured from the difference of two flats only if the ratio of their signal levels is at most this value.
# It is small because persistence of earlier exposures remains in flats.
_MAX_FLAT_RATIO = 1.03
# The gain is not measured with frames whose signal level is above this fraction of the saturation level.
_MAX_FULL = 0.7
# The gain of an amplifier with fewer pixels of blank sky than this number is not measured.
_MIN_PIXELS = 60_000


def check(context: FrameContext) -> list[Row]:
    """Check the measured gain of each amplifier, and the mean of all amplifiers, divided by the gain in the header.

    Returns rows (measurements with expected value 1 and verdict). The row is "not_applicable" if no amplifier can be
    measured or the two frames have different sizes.
    """
    assert context.partner is not None
    other_frame = frames.open_frame(context.partner.path, context.frame.instrument)
    if other_frame.electrons.shape != context.frame.electrons.shape:
        return [not_applicable("gain", context.place, "the other frame has another size", SOURCE)]
    max_ratio = _MAX_SKY_RATIO if context.sees_sky else _MAX_FLAT_RATIO
    tile_pair = [_tiles(context.frame, context.sources), _tiles(other_frame, context.partner.sources)]
    factor = ramp_factor(context) if context.channel in RAMPS else 1.0
    measurements = []
    for amplifier, other_amplifier in zip(context.frame.amplifiers, other_frame.amplifiers, strict=True):
        measurement = _pair_gain(context.frame, tile_pair, (amplifier, other_amplifier), factor, max_ratio)
        if measurement is not None:
            measurements.append((amplifier.name.rpartition(".")[2], *measurement))
    pair_note = f"with exposure {context.partner.exposure_id}"
    if not measurements:
        why = f"{pair_note}: too few blank pixels ({_MIN_PIXELS} required), or levels too different or too high"
        return [not_applicable("gain", context.place, why, SOURCE)]
    rows = [Row("gain", f"pair_{name}", context.place, gain, error, 1.0, TOLERANCE, "", SOURCE,
                note=f"{pixels} blank pixels, level {level:.4g} e-, {pair_note}")
            for name, gain, error, level, pixels in measurements if len(measurements) > 1]  # fmt: skip
    gains, errors = (np.array([measurement[i] for measurement in measurements]) for i in (1, 2))
    weight = 1.0 / errors**2
    mean, error = float((weight * gains).sum() / weight.sum()), float(weight.sum() ** -0.5)
    blank_pixels = sum(measurement[4] for measurement in measurements)
    note = f"{blank_pixels} blank pixels of {len(measurements)} amplifiers, {pair_note}"
    return [*rows, Row("gain", "pair", context.place, mean, error, 1.0, TOLERANCE, "", SOURCE, note=note)]


def _tiles(frame: Frame, sources: Reference) -> Tiles:
    return blank_sky.tiles(frame, sources, blank_sky.rough_noise(frame), tile_step=1)


def _pair_gain(
    frame: Frame, tile_pair: list[Tiles], amplifiers: tuple[Amplifier, Amplifier], factor: float, max_ratio: float
) -> tuple[float, float, float, int] | None:
    """Measure the gain of one amplifier from blank pixels in two frames, divided by the gain in the header.

    Returns the ratio, its standard error, the level of the first frame (e-) and the number of pixels. The result is
    None if there are too few pixels, if the levels are too high or too different, or if there is no photon noise.
    `factor` is the variance per electron of light (1, except for infrared ramps).
    """
    a, b = (tiles.in_amplifier(amplifier) for tiles, amplifier in zip(tile_pair, amplifiers, strict=True))
    a, b = a.select(_shared_tiles(a, b)), b.select(_shared_tiles(b, a))
    common = a.blank & b.blank
    enough = common.sum(axis=(1, 2)) > 0.2 * blank_sky.SIDE**2
    a, b, common = a.select(enough), b.select(enough), common[enough]
    n_pixels = int(common.sum())
    if n_pixels < _MIN_PIXELS or len(common) < 2:
        return None
    light = [np.asarray(frame.linearize(tiles.pixels), np.float64) for tiles in (a, b)]
    level = [float(np.mean(image[common])) for image in light]
    if min(level) <= 0.0 or max(level) > _MAX_FULL * amplifiers[0].saturation_level:
        return None
    ratio = level[0] / level[1]
    if not 1.0 / max_ratio < ratio < max_ratio:
        return None
    value, error = covariances.pixel_variance(
        light[0] - ratio * light[1], common, _BRIGHT_REACH if max(level) > _BRIGHT_LEVEL else _SKY_REACH
    )
    photon_variance = value - read_variance(amplifiers[0]) - ratio**2 * read_variance(amplifiers[1])
    if photon_variance <= 0.0:
        return None
    gain = factor * (level[0] + ratio**2 * level[1]) / photon_variance
    return gain, gain * error / photon_variance, level[0], n_pixels


def _shared_tiles(a: Tiles, b: Tiles) -> Bool:
    """Return a mask that is True for the tiles of `a` whose position (first row and column) is also in `b`."""
    positions = set(zip(b.row.tolist(), b.column.tolist(), strict=True))
    return np.array([position in positions for position in zip(a.row.tolist(), a.column.tolist(), strict=True)], bool)


def _why_not_applicable(context: FrameContext) -> str:
    return (
        ""
        if context.partner is not None
        else "no other frame of this detector, or the gain is measured with another frame"
    )


GAIN = FrameCheck("gain", SOURCE, _why_not_applicable, check)
