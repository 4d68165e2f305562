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
from truesky.validation.lake.measure.rows import Row, not_applicable
from truesky.validation.lake.measure.seen import Check, Seen, wants_blank
from truesky.validation.verdicts import LEAST

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
_LEAST = 20
# Part of the pixels that objects may cover.
_CROWDED = 0.75


class Crowded(Exception):
    """More pixels of objects than sep holds at a time."""


def check(of: Seen) -> list[Row]:
    """Magnitude at which half of the sources are found, against the noise's; part of brighter ones that are."""
    try:
        magnitude, found, chance, note = searched(of)
    except Crowded as crowd:
        return [not_applicable("completeness", of.place, f"sep: {crowd}", SOURCE)]
    if chance > _CROWDED:
        return [not_applicable("completeness", of.place, f"objects cover {chance:.0%} of the pixels", SOURCE)]
    edges = np.arange(np.floor(magnitude.min(initial=20.0)), 29.0, _BIN)
    count = np.histogram(magnitude, edges)[0].astype(float)
    part = _found(np.histogram(magnitude[found], edges)[0] / np.maximum(count, 1.0), chance)
    middle = 0.5 * (edges[1:] + edges[:-1])
    known = count >= 8
    of.series["completeness"] = np.stack([middle, part, count], axis=1)
    below = np.flatnonzero(known & (part < 0.5))
    faintest = [i for i in below if i > 0 and known[i - 1] and part[i - 1] >= 0.5]
    if not faintest or len(magnitude) < _LEAST:
        why = "no magnitude at which half are found"
        # Those that noise hides from nobody are to be found nevertheless.
        rows = _bright(of, magnitude, found, chance, _foreseen(of))
        return rows or [not_applicable("completeness", of.place, why, SOURCE)]
    i = faintest[0]
    slope = max(part[i - 1] - part[i], 0.05)
    limit = middle[i - 1] + _BIN * (part[i - 1] - 0.5) / slope
    error = _BIN * np.sqrt(0.25 / count[i] + 0.25 / count[i - 1]) / slope
    rows = [Row("completeness", "half", of.place, float(limit), float(error), _foreseen(of), _LIMIT, "mag", SOURCE,
                note=note)]  # fmt: skip
    return [*rows, *_bright(of, magnitude, found, chance, limit)]


def _found(covered: Float, chance: float) -> Float:
    """Part that is found, of the part that is covered."""
    return np.maximum(covered - chance, 0.0) / (1.0 - chance)


def _bright(of: Seen, magnitude: Float, found: Bool, chance: float, limit: float) -> list[Row]:
    """Part of the sources one to four magnitudes above a limit that are found; nothing of too few."""
    bright = (magnitude < limit - 1.0) & (magnitude > limit - 4.0)
    n = int(bright.sum())
    if n < _LEAST:
        return []
    value = float(_found(np.array(found[bright].mean()), chance))
    near = (found[bright].sum() + 2.0) / (n + 4.0)
    error = float(np.sqrt(near * (1.0 - near) / n)) / (1.0 - chance)
    return [Row("completeness", "bright", of.place, value, error, 1.0, _BRIGHT, "", SOURCE, LEAST, f"{n} sources")]


def searched(of: Seen) -> tuple[Float, Bool, float, str]:
    """(magnitudes of the known sources of a part [n], which of them are covered, which part of it is, what it is).

    Errors : Crowded
    """
    assert of.tiles is not None
    ny, nx = of.frame.electrons.shape
    # Beside the middle, where detectors that are read in parts have no pixels.
    top, left = (max(min(n // 2 + 8, n - _SIDE), 0) for n in (ny, nx))
    part = np.ascontiguousarray(of.frame.electrons[top : top + _SIDE, left : left + _SIDE], np.float64)
    level = float(np.median(of.tiles.level))
    full = masks.grown(part >= of.frame.full, times=4)
    width = float(of.frame.header["PSFFWHM"]) / of.frame.scale
    axis = np.arange(-int(np.ceil(width)), int(np.ceil(width)) + 1)
    kernel = np.exp(-4.0 * np.log(2.0) * (axis[:, None] ** 2 + axis**2) / width**2)
    # Those that touch are not told apart: pixels that objects cover are the same to 0.5 %, in a third of the time.
    try:
        objects, which = sep.extract(part - level, _THRESHOLD, err=of.noise, minarea=_PIXELS, filter_kernel=kernel,
                                     deblend_nthresh=1, mask=full, segmentation_map=True)  # fmt: skip
    except Exception as error:
        # Of sep's own errors, which have no class: its limit of pixels.
        if "pixel buffer full" not in str(error):
            raise
        raise Crowded(str(error).partition(".")[0]) from None
    covered = masks.grown(which > 0)
    known = of.known
    inside = (known.x > left + 8) & (known.x < left + part.shape[1] - 9)
    inside &= (known.y > top + 8) & (known.y < top + part.shape[0] - 9) & (known.expected > 0.0)
    x, y = known.x[inside] - left, known.y[inside] - top
    good = ~full[np.rint(y).astype(int), np.rint(x).astype(int)]
    light = known.expected[inside][good]
    magnitude = float(of.frame.header["ZEROPNT"]) - 2.5 * np.log10(light / of.frame.seconds)
    found = covered[np.rint(y[good]).astype(int), np.rint(x[good]).astype(int)]
    note = f"{len(light)} sources in {part.shape[1]} x {part.shape[0]} pixels, {len(objects)} objects"
    return magnitude, found, float(covered[~full].mean()) if not full.all() else 0.0, note


def _foreseen(of: Seen) -> float:
    """AB of a source whose light is ten times the noise within the PSF's width and, of galaxies, 0.5"."""
    extended = _GALAXY * float(np.mean(~of.known.point))
    radius = np.hypot(float(of.frame.header["PSFFWHM"]), extended) / of.frame.scale
    noise = of.noise * np.sqrt(np.pi) * radius
    return float(float(of.frame.header["ZEROPNT"]) - 2.5 * np.log10(_SIGMA * noise / of.frame.seconds))


COMPLETENESS = Check("completeness", SOURCE, wants_blank, check)
