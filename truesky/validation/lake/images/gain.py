"""Check the gain from two frames of a detector, whose difference is free of the pixel response.

Notes
-----
Counts of S electrons have the variance S. Charge sharing between neighbours, by capacitance or because full pixels
repel charge, moves part of this variance to covariances with neighbours; variance and covariances are added. Offsets
of rows or columns and slopes cause covariances at larger distances, which are measured there and subtracted.

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
TOLERANCE = 0.015
# Distance in pixels over which charge is shared: for sky, and above the given level in e-.
_SKY_REACH, _BRIGHT_REACH, _BRIGHT_LEVEL = 1, 2, 5000.0
# Largest ratio of the levels of two frames, for sky and for flats (earlier exposures leave traces in flats); largest
# level as a fraction of the full well; smallest number of pixels per amplifier.
_MAX_SKY_RATIO, _MAX_FLAT_RATIO, _MAX_FULL, _MIN_PIXELS = 30.0, 1.03, 0.7, 60_000


def check(context: FrameContext) -> list[Row]:
    """Check the gain of each amplifier and their mean."""
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
    """Gain over that in the header, its error, level (e-), and number of pixels; None if not measurable."""
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
    """True for the tiles of `a` that are also in `b`."""
    positions = set(zip(b.row.tolist(), b.column.tolist(), strict=True))
    return np.array([position in positions for position in zip(a.row.tolist(), a.column.tolist(), strict=True)], bool)


def _why_not_applicable(context: FrameContext) -> str:
    return (
        ""
        if context.partner is not None
        else "no other frame of this detector, or the gain is measured with another frame"
    )


GAIN = FrameCheck("gain", SOURCE, _why_not_applicable, check)
