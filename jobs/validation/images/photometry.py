"""How bright stars are, against the catalogue's band fluxes: all of their light, and how it goes with magnitude.

What is beyond an aperture, and what of it was taken off as the sky beside the star, is told by the wings of the frame's
brightest stars (measure/wings.py). Where these do not tell it, wings fall as r^-3: what is within r lacks k / r of the
light, and k (1 / r + pi r^2 s) is missing, s the mean of 1 / (2 pi r^3) where the sky was taken; k is told by the last
apertures of the stars' mean curve of growth.
"""

from __future__ import annotations

import numpy as np

from jobs import sums
from jobs.validation.measure.rows import Row, not_applicable
from jobs.validation.measure.seen import Check, Seen, wants_stars
from jobs.validation.measure.stars import Measured
from lake_schema.arrays import Float

SOURCE = "Serrano et al. 2024, app. C: below 0.02 mag, aperture and PSF photometry"
TOLERANCE = 0.02
# A star's aperture is the one that holds about so much of a point's light.
_HELD, _LEAST = 0.8, 8
_WINGS = slice(-4, None)
# The aperture from which the wings go on: in a wider one the error of its sky weighs more.
_JOIN = -3
# Part of the full well above which what the detector is not linear in shows.
_LINEAR = 0.2


def check(of: Seen) -> list[Row]:
    """Offset from the catalogue's magnitudes, and its slope with them."""
    assert of.measured is not None
    magnitude, error = magnitudes(of.measured, float(of.frame.header["ZEROPNT"]), of.frame.seconds)
    stars = of.measured.stars
    off = magnitude - stars.mag
    known = np.isfinite(off) & np.isfinite(error) & (stars.peak + stars.sky < _LINEAR * of.frame.full)
    if known.sum() < _LEAST:
        return [not_applicable("photometry", of.place, "too few stars at which the detector is linear", SOURCE)]
    kept, spread, line = known, _spread(off[known]), np.zeros(2)
    about = float(np.median(stars.mag[known]))
    faint = stars.mag - about
    # Stars that a cosmic ray hit are told by a line through the others.
    for _ in range(3):
        left = off - line[0] - line[1] * faint
        kept = known & (np.abs(left - np.median(left[known])) < 5.0 * spread)
        weight = 1.0 / (error[kept] ** 2 + spread**2)
        matrix = np.stack([np.ones(kept.sum()), faint[kept]], axis=1)
        inverse = sums.least_squares(matrix * np.sqrt(weight)[:, None], np.eye(len(matrix)))
        line = (inverse * (np.sqrt(weight) * off[kept])).sum(axis=1)
        spread = _spread((off - line[0] - line[1] * faint)[kept])
    errors = np.sqrt((inverse**2).sum(axis=1))
    of.series |= {"mag": stars.mag, "dm": off, "measured": np.where(kept, magnitude, np.nan)}
    of.series["mean_dm"] = np.array([line[0], errors[0]])
    note = f"{int(kept.sum())} stars, AB {stars.mag[kept].min():.1f} to {stars.mag[kept].max():.1f}"
    place = of.place
    return [
        Row("photometry", "offset", place, line[0], errors[0], 0.0, TOLERANCE, "mag", SOURCE, note=note),
        Row("photometry", "slope", place, line[1], errors[1], 0.0, TOLERANCE, "mag/mag", SOURCE, note=note),
    ]


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
        return zero_point - 2.5 * np.log10(light / seconds), 1.0857 / found.stars.snr


def curve(found: Measured) -> tuple[Float, float]:
    """(mean light within the radii, all light), of a point whose light within the widest aperture is 1."""
    bright = np.argsort(-found.stars.flux, kind="stable")[: max(len(found.stars) // 2, _LEAST)]
    own = found.stars.growth[bright]
    held = np.median(own / own[:, -1:], axis=0)
    if found.wings is not None:
        joined = float(found.radii[_JOIN])
        lost = found.wings.beyond(joined) + np.pi * joined**2 * float(found.wings.at(found.sky_at).mean())
        return held, float(held[_JOIN]) / (1.0 - lost)
    radius = found.radii[_WINGS]
    missing = 1.0 / radius + np.pi * radius**2 * float(np.mean(0.5 / np.pi / found.sky_at**3))
    total, slope = sums.least_squares(np.stack([np.ones(len(missing)), missing], axis=1), held[_WINGS])
    return held, float(total) if slope < 0.0 else float(held[-1])


PHOTOMETRY = Check("photometry", SOURCE, wants_stars(_LEAST), check)
