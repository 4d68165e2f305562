"""Which of the known sources a program finds in the pixels: sep, in a part of each frame.

A source is found where an object covers its place, be it one with a cosmic ray or a neighbour. Of all places objects
cover a part c by chance: where p of the sources are covered, (p - c) / (1 - c) are found. Where they cover most of
the places that says nothing.
"""

from __future__ import annotations

import numpy as np
import sep

from lake_schema.arrays import Bool, Float
from truesky.validation.lake.measure import masks
from truesky.validation.lake.measure.frame_context import FrameCheck, FrameContext, require_blank_sky
from truesky.validation.lake.measure.rows import Row, not_applicable
from truesky.validation.verdicts import AT_LEAST

SOURCE = (
    "sep (Barbary 2016) as SourceExtractor: 5 pixels above 1.5 sigma after a filter of the PSF's width, not deblended"
)
# Side of the part that is searched, pixels; magnitudes of a bin.
_SIDE, _BIN = 1024, 0.5
_THRESHOLD, _PIXELS = 1.5, 5
# Of sources one to four magnitudes above where half are found; of the magnitude of that, against the noise's.
_BRIGHT, _LIMIT = 0.15, 0.75
# Times the noise, and arcsec about a galaxy, of a source that is found as often as not.
_SIGMA, _GALAXY = 10.0, 0.5
_MIN_SOURCES = 20
# Part of the pixels that objects may cover.
_CROWDED = 0.75


class Crowded(Exception):
    """More pixels of objects than sep holds at a time."""


def check(context: FrameContext) -> list[Row]:
    """Magnitude at which half of the sources are found, against the noise's; part of brighter ones that are."""
    try:
        magnitude, is_found, chance, note = search_sources(context)
    except Crowded as crowd:
        return [not_applicable("completeness", context.place, f"sep: {crowd}", SOURCE)]
    if chance > _CROWDED:
        return [not_applicable("completeness", context.place, f"objects cover {chance:.0%} of the pixels", SOURCE)]
    edges = np.arange(np.floor(magnitude.min(initial=20.0)), 29.0, _BIN)
    count = np.histogram(magnitude, edges)[0].astype(float)
    fraction = _found_fraction(np.histogram(magnitude[is_found], edges)[0] / np.maximum(count, 1.0), chance)
    middle = 0.5 * (edges[1:] + edges[:-1])
    well_sampled = count >= 8
    context.series["completeness"] = np.stack([middle, fraction, count], axis=1)
    below = np.flatnonzero(well_sampled & (fraction < 0.5))
    faintest = [i for i in below if i > 0 and well_sampled[i - 1] and fraction[i - 1] >= 0.5]
    if not faintest or len(magnitude) < _MIN_SOURCES:
        why = "no magnitude at which half are found"
        # Those that noise hides from nobody are to be found nevertheless.
        rows = _bright_rows(context, magnitude, is_found, chance, _expected_limit(context))
        return rows or [not_applicable("completeness", context.place, why, SOURCE)]
    i = faintest[0]
    slope = max(fraction[i - 1] - fraction[i], 0.05)
    limit = middle[i - 1] + _BIN * (fraction[i - 1] - 0.5) / slope
    error = _BIN * np.sqrt(0.25 / count[i] + 0.25 / count[i - 1]) / slope
    rows = [
        Row(
            "completeness",
            "half",
            context.place,
            float(limit),
            float(error),
            _expected_limit(context),
            _LIMIT,
            "mag",
            SOURCE,
            note=note,
        )
    ]
    return [*rows, *_bright_rows(context, magnitude, is_found, chance, limit)]


def _found_fraction(covered: Float, chance: float) -> Float:
    """Part that is found, of the part that is covered."""
    return np.maximum(covered - chance, 0.0) / (1.0 - chance)


def _bright_rows(context: FrameContext, magnitude: Float, is_found: Bool, chance: float, limit: float) -> list[Row]:
    """Part of the sources one to four magnitudes above a limit that are found; nothing of too few."""
    bright = (magnitude < limit - 1.0) & (magnitude > limit - 4.0)
    n = int(bright.sum())
    if n < _MIN_SOURCES:
        return []
    value = float(_found_fraction(np.array(is_found[bright].mean()), chance))
    adjusted_share = (is_found[bright].sum() + 2.0) / (n + 4.0)
    error = float(np.sqrt(adjusted_share * (1.0 - adjusted_share) / n)) / (1.0 - chance)
    return [
        Row("completeness", "bright", context.place, value, error, 1.0, _BRIGHT, "", SOURCE, AT_LEAST, f"{n} sources")
    ]


def search_sources(context: FrameContext) -> tuple[Float, Bool, float, str]:
    """(magnitudes of the known sources of a part [n], which of them are covered, which part of it is, what it is).

    Errors : Crowded
    """
    assert context.tiles is not None
    ny, nx = context.frame.electrons.shape
    # Beside the middle, where detectors that are read in parts have no pixels.
    first_row, first_column = (max(min(n // 2 + 8, n - _SIDE), 0) for n in (ny, nx))
    cutout = np.ascontiguousarray(
        context.frame.electrons[first_row : first_row + _SIDE, first_column : first_column + _SIDE], np.float64
    )
    level = float(np.median(context.tiles.level))
    full = masks.dilate(cutout >= context.frame.saturation_level, times=4)
    width = float(context.frame.header["PSFFWHM"]) / context.frame.scale
    axis = np.arange(-int(np.ceil(width)), int(np.ceil(width)) + 1)
    kernel = np.exp(-4.0 * np.log(2.0) * (axis[:, None] ** 2 + axis**2) / width**2)
    # Those that touch are not told apart: pixels that objects cover are the same to 0.5 %, in a third of the time.
    try:
        objects, segmentation = sep.extract(
            cutout - level,
            _THRESHOLD,
            err=context.noise,
            minarea=_PIXELS,
            filter_kernel=kernel,
            deblend_nthresh=1,
            mask=full,
            segmentation_map=True,
        )
    except Exception as error:
        # Of sep's own errors, which have no class: its limit of pixels.
        if "pixel buffer full" not in str(error):
            raise
        raise Crowded(str(error).partition(".")[0]) from None
    covered = masks.dilate(segmentation > 0)
    sources = context.sources
    inside = (sources.x > first_column + 8) & (sources.x < first_column + cutout.shape[1] - 9)
    inside &= (sources.y > first_row + 8) & (sources.y < first_row + cutout.shape[0] - 9) & (sources.expected > 0.0)
    x, y = sources.x[inside] - first_column, sources.y[inside] - first_row
    good = ~full[np.rint(y).astype(int), np.rint(x).astype(int)]
    light = sources.expected[inside][good]
    magnitude = float(context.frame.header["ZEROPNT"]) - 2.5 * np.log10(light / context.frame.seconds)
    is_found = covered[np.rint(y[good]).astype(int), np.rint(x[good]).astype(int)]
    note = f"{len(light)} sources in {cutout.shape[1]} x {cutout.shape[0]} pixels, {len(objects)} objects"
    return magnitude, is_found, float(covered[~full].mean()) if not full.all() else 0.0, note


def _expected_limit(context: FrameContext) -> float:
    """AB of a source whose light is ten times the noise within the PSF's width and, of galaxies, 0.5"."""
    extended = _GALAXY * float(np.mean(~context.sources.point))
    radius = np.hypot(float(context.frame.header["PSFFWHM"]), extended) / context.frame.scale
    noise = context.noise * np.sqrt(np.pi) * radius
    return float(float(context.frame.header["ZEROPNT"]) - 2.5 * np.log10(_SIGMA * noise / context.frame.seconds))


COMPLETENESS = FrameCheck("completeness", SOURCE, require_blank_sky, check)
