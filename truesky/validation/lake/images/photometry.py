"""How bright stars are, against the catalogue's band fluxes: all of their light, and how it goes with magnitude.

What is beyond an aperture, and what of it was taken off as the sky beside the star, is told by the wings of the frame's
brightest stars (measure/wings.py).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lake_schema.arrays import Bool, Float
from truesky.validation.lake.measure import effective
from truesky.validation.lake.measure.rows import Row, not_applicable
from truesky.validation.lake.measure.seen import Check, Seen, wants_stars
from truesky.validation.lake.measure.stars import Measured
from truesky.validation.lake.measure.wings import Wings

SOURCE = "Serrano et al. 2024, app. C: below 0.02 mag, aperture and PSF photometry"
TOLERANCE = 0.02
# 2.5 / ln 10.
_MAGNITUDE = 1.0857
# A star's aperture is the one that holds about so much of a point's light.
_HELD, _LEAST = 0.8, 8
# The aperture from which the wings go on: in a wider one the error of its sky weighs more.
_JOIN = -3
# Part of the full well above which what the detector is not linear in shows.
_LINEAR = 0.2


def check(of: Seen) -> list[Row]:
    """Offset from the catalogue's magnitudes, and its slope with them, of apertures and of a PSF that is fitted."""
    assert of.measured is not None
    stars, zero_point = of.measured.stars, float(of.frame.header["ZEROPNT"])
    magnitude, error = magnitudes(of.measured, zero_point, of.frame.seconds)
    linear = stars.peak + stars.sky < _LINEAR * of.frame.full
    off = magnitude - stars.mag
    known = np.isfinite(off) & np.isfinite(error) & linear
    if known.sum() < _LEAST:
        return [not_applicable("photometry", of.place, "too few stars at which the detector is linear", SOURCE)]
    line, errors, kept = _line(off, error, stars.mag, known)
    of.series |= {"mag": stars.mag, "dm": off, "measured": np.where(kept, magnitude, np.nan)}
    of.series["mean_dm"] = np.array([line[0], errors[0]])
    beyond = _unsure(of.measured)
    rows = _rows(of, "", line, np.hypot(errors, (beyond, 0.0)), kept)
    whole = np.where(kept, of.frame.seconds * 10 ** (-0.4 * (magnitude - zero_point)), np.nan)
    light, its = effective.lights(of.frame, of.measured, whole, of.noise)
    with np.errstate(divide="ignore", invalid="ignore"):
        off = zero_point - 2.5 * np.log10(light / of.frame.seconds) - stars.mag
        error = _MAGNITUDE * its / light
    known = np.isfinite(off) & np.isfinite(error) & linear
    if known.sum() < _LEAST:
        return [*rows, not_applicable("photometry", of.place, "too few stars for a PSF", SOURCE, "psf_offset")]
    line, errors, kept = _line(off, error, stars.mag, known)
    return [*rows, *_rows(of, "psf_", line, np.hypot(errors, (beyond, 0.0)), kept)]


def _line(off: Float, error: Float, mag: Float, known: Bool) -> tuple[Float, Float, Bool]:
    """((offset at the median magnitude, slope), their errors, which of the stars [n] they are of).

    off, error : of magnitudes;  mag : of the catalogue;  known : which are asked
    """
    kept, spread, line = known, _spread(off[known]), np.zeros(2)
    faint = mag - float(np.median(mag[known]))
    # Stars that a cosmic ray hit are told by a line through the others.
    for _ in range(3):
        left = off - line[0] - line[1] * faint
        kept = known & (np.abs(left - np.median(left[known])) < 5.0 * spread)
        weight = 1.0 / (error[kept] ** 2 + spread**2)
        matrix = np.stack([np.ones(kept.sum()), faint[kept]], axis=1)
        inverse = np.linalg.pinv(matrix * np.sqrt(weight)[:, None])
        line = inverse @ (np.sqrt(weight) * off[kept])
        spread = _spread((off - line[0] - line[1] * faint)[kept])
    return line, np.sqrt((inverse**2).sum(axis=1)), kept


def _rows(of: Seen, name: str, line: Float, errors: Float, kept: Bool) -> list[Row]:
    assert of.measured is not None
    mag = of.measured.stars.mag[kept]
    note = f"{int(kept.sum())} stars, AB {mag.min():.1f} to {mag.max():.1f}"
    return [
        Row("photometry", f"{name}{quantity}", of.place, value, error, 0.0, TOLERANCE, unit, SOURCE, note=note)
        for quantity, value, error, unit in zip(("offset", "slope"), line, errors, ("mag", "mag/mag"), strict=True)
    ]


def _unsure(found: Measured) -> float:
    """mag: the offset's error by that of the wings."""
    return _MAGNITUDE * _lost(found, replace(found.wings, strength=found.wings.error))


def _lost(found: Measured, wings: Wings) -> float:
    """Part of all light that an aperture lacks: beyond it, and taken off as the sky."""
    joined = float(found.radii[_JOIN])
    return wings.beyond(joined) + np.pi * joined**2 * float(wings.at(found.sky_at).mean())


def _spread(values: Float) -> float:
    return 1.4826 * float(np.median(np.abs(values - np.median(values)))) + 1e-6


def magnitudes(found: Measured, zero_point: float, seconds: float) -> tuple[Float, Float]:
    """AB [n] of all light, and its error from the star's own photons and its sky.

    found : stars and their curves of growth;  zero_point : mag of 1 e-/s;  seconds : exposure time
    """
    held, total = curve(found)
    chosen = int(np.argmin(np.abs(held / total - _HELD)))
    light = found.stars.growth[:, chosen] * (total / held[chosen])
    with np.errstate(divide="ignore", invalid="ignore"):
        return zero_point - 2.5 * np.log10(light / seconds), _MAGNITUDE / found.stars.snr


def curve(found: Measured) -> tuple[Float, float]:
    """(mean light within the radii, all light), of a point whose light within the widest aperture is 1."""
    bright = np.argsort(-found.stars.flux, kind="stable")[: max(len(found.stars) // 2, _LEAST)]
    own = found.stars.growth[bright]
    held = np.median(own / own[:, -1:], axis=0)
    return held, float(held[_JOIN]) / (1.0 - _lost(found, found.wings))


PHOTOMETRY = Check("photometry", SOURCE, wants_stars(_LEAST), check)
