"""A filter that its wheel leaves a little tilted displaces the image, and bends it.

A plane-parallel plate of thickness t, index n and normal N displaces a ray of direction d, both of length 1, across
itself by

    w = t (1 - sqrt((1 - s^2) / (n^2 - s^2))) (N - (N d) d),   s^2 = 1 - (N d)^2
      = t (a + c s^2) (N - (N d) d),   a = 1 - 1 / n,   c = (n^2 - 1) / (2 n^3)

to the order s^4.  The chief ray of a place in the field has the components phi across the axis, m times its angle on
the sky, m the telescope's focal length over the collimator's.  On a screen across the axis, what w changes by where
the normal leans by the small vector delta is

    D(phi) = t ((a + c |phi|^2) delta + 2 c (phi delta) phi)

a shift of the whole image and, a hundredth of it at the field's corners, a distortion of second order.  Both are known:
the world coordinate system of an exposure has them.

tilted      a detector behind the filter of an exposure;  displaced : of a given tilt
"""

from __future__ import annotations

from dataclasses import replace

from truesky.randomness import rng
from truesky.render.camera import distortion
from truesky.render.camera.detectors import Detector
from truesky.render.camera.pointing import ARCSEC


def apply_random_tilt(detector: Detector, exposure: str, seed: int) -> Detector:
    """The detector as the exposure's filter lets it see: displaced, and behind another distortion.

    The tilt is normally distributed, of the wheel's error in both directions together.
    Error : 3e-4 of the shift, of fourth order in the angle of the ray

    detector : of the camera;  exposure : what its tilt is keyed by;  seed : of the request
    """
    filter_wheel = detector.filter_wheel
    if filter_wheel is None or not filter_wheel.tilt_rms:
        return detector
    stream = rng.stream(seed, "filter_wheel", exposure)
    tilt_x, tilt_y = (float(part) for part in stream.normal(0.0, filter_wheel.tilt_rms * 0.5**0.5, 2))
    return apply_tilt(detector, tilt_x, tilt_y)


def apply_tilt(detector: Detector, tilt_x: float, tilt_y: float) -> Detector:
    """The same for a tilt (rad) by which the filter's normal leans along the focal plane's x and y axes.

    A place of the detector sees what, without the tilt, is seen so much before it.
    detector : of the camera;  across, up : of the tilt
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
