"""Check the measured magnitudes of stars against the catalogue: mean offset, and its slope with magnitude.

Notes
-----
A finite aperture misses the wings of a star, and some light of the wings is subtracted with the sky around the star.
Both losses are computed from the wings of the brightest stars in the frame (measure/wings.py).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lake_schema.arrays import Bool, Float
from truesky.validation.lake.measure import effective_psf
from truesky.validation.lake.measure.frame_context import FrameCheck, FrameContext, require_stars
from truesky.validation.lake.measure.rows import Row, not_applicable
from truesky.validation.lake.measure.stars import StarMeasurements
from truesky.validation.lake.measure.wings import Wings

SOURCE = "Serrano et al. 2024, app. C: below 0.02 mag, aperture and PSF photometry"
# Tolerance of the measured minus the catalogue magnitude (mag), and of the slope of this difference (mag per mag).
TOLERANCE = 0.02
# Error of a magnitude divided by the relative error of the flux: 2.5 / ln 10.
_MAGNITUDE = 1.0857
# Stars are measured in the aperture that contains about this fraction of the light of a point source.
_APERTURE_FRACTION = 0.8
# With fewer measured stars than this number, the check is not applicable.
_MIN_STARS = 8
# Index, in the list of apertures, of the widest one that is used for total light, which the wings complete.
# In wider apertures the error of the sky dominates.
_JOIN_APERTURE = -3
# Stars whose brightest pixel is above this fraction of the saturation level are not used, because of nonlinearity.
_LINEAR = 0.2


def check(context: FrameContext) -> list[Row]:
    """Check the magnitudes of the stars of a frame, by aperture photometry and by PSF fits.

    For each method the rows (measurements with expected value 0 and verdict) are the offset from the catalogue at the
    median magnitude, and the slope of the offset with magnitude. With fewer than eight stars in the linear range, the
    row is "not_applicable".
    """
    assert context.measurements is not None
    stars, zero_point = context.measurements.stars, float(context.frame.header["ZEROPNT"])
    magnitude, error = magnitudes(context.measurements, zero_point, context.frame.seconds)
    linear = stars.peak + stars.sky < _LINEAR * context.frame.saturation_level
    offset = magnitude - stars.mag
    usable = np.isfinite(offset) & np.isfinite(error) & linear
    if usable.sum() < _MIN_STARS:
        return [
            not_applicable("photometry", context.place, "too few stars in the linear range of the detector", SOURCE)
        ]
    line, errors, used = _fit_line(offset, error, stars.mag, usable)
    context.series |= {"mag": stars.mag, "dm": offset, "measured": np.where(used, magnitude, np.nan)}
    context.series["mean_dm"] = np.array([line[0], errors[0]])
    wing_error = _wing_error(context.measurements)
    rows = _rows(context, "", line, np.hypot(errors, (wing_error, 0.0)), used)
    total_light = np.where(used, context.frame.seconds * 10 ** (-0.4 * (magnitude - zero_point)), np.nan)
    light, light_error = effective_psf.fit_fluxes(context.frame, context.measurements, total_light, context.noise)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = zero_point - 2.5 * np.log10(light / context.frame.seconds) - stars.mag
        error = _MAGNITUDE * light_error / light
    usable = np.isfinite(offset) & np.isfinite(error) & linear
    if usable.sum() < _MIN_STARS:
        return [*rows, not_applicable("photometry", context.place, "too few stars for a PSF fit", SOURCE, "psf_offset")]
    line, errors, used = _fit_line(offset, error, stars.mag, usable)
    return [*rows, *_rows(context, "psf_", line, np.hypot(errors, (wing_error, 0.0)), used)]


def _fit_line(offset: Float, error: Float, mag: Float, usable: Bool) -> tuple[Float, Float, Bool]:
    """Fit a line to the magnitude offsets of the `usable` stars, and reject outliers such as stars with cosmic rays.

    Returns (offset at the median magnitude, slope), their standard errors, and a mask of the stars used.
    """
    used, spread, line = usable, _spread(offset[usable]), np.zeros(2)
    relative_mag = mag - float(np.median(mag[usable]))
    for _ in range(3):
        residual = offset - line[0] - line[1] * relative_mag
        used = usable & (np.abs(residual - np.median(residual[usable])) < 5.0 * spread)
        weight = 1.0 / (error[used] ** 2 + spread**2)
        matrix = np.stack([np.ones(used.sum()), relative_mag[used]], axis=1)
        inverse = np.linalg.pinv(matrix * np.sqrt(weight)[:, None])
        line = inverse @ (np.sqrt(weight) * offset[used])
        spread = _spread((offset - line[0] - line[1] * relative_mag)[used])
    return line, np.sqrt((inverse**2).sum(axis=1)), used


def _rows(context: FrameContext, name: str, line: Float, errors: Float, used: Bool) -> list[Row]:
    assert context.measurements is not None
    mag = context.measurements.stars.mag[used]
    note = f"{int(used.sum())} stars, AB {mag.min():.1f} to {mag.max():.1f}"
    return [
        Row("photometry", f"{name}{quantity}", context.place, value, error, 0.0, TOLERANCE, unit, SOURCE, note=note)
        for quantity, value, error, unit in zip(("offset", "slope"), line, errors, ("mag", "mag/mag"), strict=True)
    ]


def _wing_error(measurements: StarMeasurements) -> float:
    """Return the error of the stars' mean magnitude offset due to the uncertain strength of the PSF's wings, mag."""
    return _MAGNITUDE * _lost_fraction(measurements, replace(measurements.wings, strength=measurements.wings.error))


def _lost_fraction(measurements: StarMeasurements, wings: Wings) -> float:
    """Return the fraction of a star's total light that the widest used aperture misses.

    The fraction consists of the light beyond this aperture, and of light of the wings inside it that was subtracted
    as sky.
    """
    join_radius = float(measurements.radii[_JOIN_APERTURE])
    return wings.fraction_beyond(join_radius) + np.pi * join_radius**2 * float(
        wings.profile(measurements.sky_at).mean()
    )


def _spread(values: Float) -> float:
    return 1.4826 * float(np.median(np.abs(values - np.median(values)))) + 1e-6


def magnitudes(measurements: StarMeasurements, zero_point: float, seconds: float) -> tuple[Float, Float]:
    """Return the total AB magnitudes of stars from aperture photometry, and their errors from photon and sky noise.

    The flux in an aperture with about 80 % of the light is corrected to the total flux of a point source.

    Parameters
    ----------
    measurements : StarMeasurements
        Measured stars of a frame with their curves of growth (light within several radii).
    zero_point : float
        AB magnitude of a source that gives 1 electron per second.
    seconds : float
        Exposure time, s.

    Returns
    -------
    magnitude, error : float array, shape (n,)
        AB magnitudes and their standard errors; NaN or infinite for stars without positive flux.
    """
    enclosed, total = growth_curve(measurements)
    aperture = int(np.argmin(np.abs(enclosed / total - _APERTURE_FRACTION)))
    light = measurements.stars.growth[:, aperture] * (total / enclosed[aperture])
    with np.errstate(divide="ignore", invalid="ignore"):
        return zero_point - 2.5 * np.log10(light / seconds), _MAGNITUDE / measurements.stars.snr


def growth_curve(measurements: StarMeasurements) -> tuple[Float, float]:
    """Return the median curve of growth of the brighter half of the stars: light of a point source in each aperture.

    The second value is the total light, including the wings. Both are relative to the light in the widest aperture.
    """
    bright = np.argsort(-measurements.stars.flux, kind="stable")[: max(len(measurements.stars) // 2, _MIN_STARS)]
    growth = measurements.stars.growth[bright]
    enclosed = np.median(growth / growth[:, -1:], axis=0)
    return enclosed, float(enclosed[_JOIN_APERTURE]) / (1.0 - _lost_fraction(measurements, measurements.wings))


PHOTOMETRY = FrameCheck("photometry", SOURCE, require_stars(_MIN_STARS), check)
