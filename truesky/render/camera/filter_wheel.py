"""Shift and distortion of the image by a filter that its wheel leaves slightly tilted.

A plane-parallel plate of thickness t and refractive index n, with the unit normal N, displaces a ray of light. For a
ray with the unit direction d, the displacement perpendicular to d is::

    w = t (1 - sqrt((1 - s^2) / (n^2 - s^2))) (N - (N d) d),   s^2 = 1 - (N d)^2
      = t (a + c s^2) (N - (N d) d),   a = 1 - 1 / n,   c = (n^2 - 1) / (2 n^3)

to the order s^4. The chief ray of a field position has components phi perpendicular to the optical axis. They are m
times the angle of the position on the sky. The magnification m is the focal length of the telescope divided by that of
the collimator. If the normal leans by the small vector delta, the displacement w changes on a screen perpendicular to
the axis by::

    D(phi) = t ((a + c |phi|^2) delta + 2 c (phi delta) phi)

This is a shift of the whole image and a distortion of second order, which reaches two hundredths of the shift at the
corners of the field. The world coordinate system of an exposure includes both.
"""

from __future__ import annotations

from dataclasses import replace

from truesky.randomness import rng
from truesky.render.camera import distortion
from truesky.render.camera.detectors import Detector
from truesky.render.camera.pointing import ARCSEC


def apply_random_tilt(detector: Detector, exposure: str, seed: int) -> Detector:
    """Return a detector with the shift and distortion that the filter's random tilt in an exposure causes.

    Parameters
    ----------
    detector : Detector
        The detector behind an untilted filter.
    exposure : str
        Identifier of the exposure, from which the random tilt is drawn.
    seed : int
        Seed of the random numbers in the request of the user.

    Returns
    -------
    Detector
        The detector at the position where it appears to be, with additional distortion terms. `detector` itself if the
        camera has no filter wheel or its rms tilt is 0.

    Notes
    -----
    The tilts along x and y are independent and normally distributed. Each has the rms `FilterWheel.tilt_rms` / sqrt(2).
    The shift has a relative error of 3e-4, of fourth order in the angle of the ray.
    """
    filter_wheel = detector.filter_wheel
    if filter_wheel is None or not filter_wheel.tilt_rms:
        return detector
    stream = rng.stream(seed, "filter_wheel", exposure)
    tilt_x, tilt_y = (float(part) for part in stream.normal(0.0, filter_wheel.tilt_rms * 0.5**0.5, 2))
    return apply_tilt(detector, tilt_x, tilt_y)


def apply_tilt(detector: Detector, tilt_x: float, tilt_y: float) -> Detector:
    """Return a detector with the shift and distortion that a filter with a given tilt causes.

    Parameters
    ----------
    detector : Detector
        The detector behind an untilted filter.
    tilt_x, tilt_y : float
        Angles by which the filter's normal leans along the focal plane's x and y axes, rad.

    Returns
    -------
    Detector
        The detector at the position where it appears to be, with additional distortion terms. `detector` itself if the
        camera has no filter wheel.

    Notes
    -----
    If the tilted filter displaces the image by D, light at a detector position P would fall on P - D without the tilt.
    """
    filter_wheel = detector.filter_wheel
    if filter_wheel is None:
        return detector
    shift, bend = filter_wheel.shift, filter_wheel.bend * ARCSEC**2
    tilt_terms = (
        (2, 0, -3.0 * bend * tilt_x, -bend * tilt_y),
        (1, 1, -2.0 * bend * tilt_y, -2.0 * bend * tilt_x),
        (0, 2, -bend * tilt_x, -3.0 * bend * tilt_y),
    )
    distortion_terms = distortion.add_terms(detector.distortion_terms, tilt_terms)
    return replace(
        detector, x=detector.x - shift * tilt_x, y=detector.y - shift * tilt_y, distortion_terms=distortion_terms
    )
