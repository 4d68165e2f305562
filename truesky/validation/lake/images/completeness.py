"""Check the completeness of detection: which of the known sources the program sep detects in a cutout of each frame.

Notes
-----
A source counts as detected if the pixels of a detected object cover its position, even if the object is a cosmic ray or
a neighbour. Objects cover a fraction c of all positions by chance. If a fraction p of the sources is covered, the
fraction (p - c) / (1 - c) is really detected. This estimate has no meaning if objects cover most of the image.
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
# Side, in pixels, of the square cutout of a frame in which sources are detected.
_SIDE = 1024
# Width of the magnitude bins in which the fraction of detected sources is measured, mag.
_BIN = 0.5
# Threshold of a pixel value for detection with the program sep, in standard deviations of the noise.
_THRESHOLD = 1.5
# Groups of fewer adjacent pixels above the threshold than this number do not count as a detected object.
_PIXELS = 5
# Allowed fraction of missed sources among those that are one to four magnitudes brighter than the 50 % limit (magnitude
# at which half of the sources are detected).
_BRIGHT = 0.15
# Tolerance of the 50 % limit (magnitude at which half of the sources are detected), mag.
_LIMIT = 0.75
# Expected signal-to-noise ratio of sources at the 50 % limit (magnitude at which half of the sources are detected).
_SIGMA = 10.0
# Typical radius of a galaxy, arcsec; it widens the aperture for which the expected 50 % limit is computed.
_GALAXY = 0.5
# With fewer known sources than this number, a fraction of detected sources is not measured.
_MIN_SOURCES = 20
# If objects cover more than this fraction of the pixels, the check does not apply.
_CROWDED = 0.75


class Crowded(Exception):
    """Exception: detected objects cover more pixels than sep can process at a time."""


def check(context: FrameContext) -> list[Row]:
    """Check the completeness of source detection in a frame with blank sky.

    The rows (measurements with expected value and verdict) are the magnitude at which half of the sources are detected,
    compared with the noise of the frame, and the detected fraction of brighter sources. A quantity with too few sources
    is left out; without any, or in a crowded frame, the row is "not_applicable".
    """
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
        # The 50 % limit cannot be measured: check only that sources brighter than the expected limit are detected.
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
    """Return the fraction of sources that are really detected.

    `covered` is the fraction of sources whose position an object covers, and `chance` the fraction of all positions
    that objects cover.
    """
    return np.maximum(covered - chance, 0.0) / (1.0 - chance)


def _bright_rows(context: FrameContext, magnitude: Float, is_found: Bool, chance: float, limit: float) -> list[Row]:
    """Check the detected fraction of sources that are one to four magnitudes brighter than `limit`.

    Returns one row with expected value and verdict, or no row with fewer than 20 such sources.
    """
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
    """Detect objects in a cutout of a frame, and find which known sources they cover.

    Parameters
    ----------
    context : FrameContext
        A frame with its known sources and measured tiles of blank sky.

    Returns
    -------
    magnitude : float array, shape (n,)
        AB magnitudes of the known sources in the cutout, without those near saturated pixels or within about 8 pixels
        of its edge.
    is_found : bool array, shape (n,)
        True if an object covers the source.
    chance : float
        Fraction of all unsaturated pixels that objects cover, 0 if all pixels are saturated.
    note : str
        Description of the sample: numbers of sources, pixels and objects.

    Raises
    ------
    Crowded
        If objects cover more pixels than sep can process.
    """
    assert context.tiles is not None
    ny, nx = context.frame.electrons.shape
    # Place the cutout next to the centre: some detectors have unread rows or gaps at the centre.
    first_row, first_column = (max(min(n // 2 + 8, n - _SIDE), 0) for n in (ny, nx))
    cutout = np.ascontiguousarray(
        context.frame.electrons[first_row : first_row + _SIDE, first_column : first_column + _SIDE], np.float64
    )
    level = float(np.median(context.tiles.level))
    full = masks.dilate(cutout >= context.frame.saturation_level, times=4)
    width = float(context.frame.header["PSFFWHM"]) / context.frame.scale
    axis = np.arange(-int(np.ceil(width)), int(np.ceil(width)) + 1)
    kernel = np.exp(-4.0 * np.log(2.0) * (axis[:, None] ** 2 + axis**2) / width**2)
    # Do not deblend objects: this changes the covered pixels by 0.5 % only, and takes a third of the time.
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
        # sep raises instances of Exception itself; only the message identifies an overflow of its pixel buffer.
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
    """Return the AB magnitude of a source whose flux is ten times the noise of the sky in a typical aperture.

    The radius of the aperture is the FWHM of the PSF, plus (in quadrature) 0.5 arcsec times the fraction of galaxies
    among the sources.
    """
    extended = _GALAXY * float(np.mean(~context.sources.point))
    radius = np.hypot(float(context.frame.header["PSFFWHM"]), extended) / context.frame.scale
    noise = context.noise * np.sqrt(np.pi) * radius
    return float(float(context.frame.header["ZEROPNT"]) - 2.5 * np.log10(_SIGMA * noise / context.frame.seconds))


COMPLETENESS = FrameCheck("completeness", SOURCE, require_blank_sky, check)
