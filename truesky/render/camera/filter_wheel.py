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


def tilted(detector: Detector, exposure: str, seed: int) -> Detector:
    """The detector as the exposure's filter lets it see: displaced, and behind another distortion.

    The tilt is normally distributed, of the wheel's error in both directions together.
    Error : 3e-4 of the shift, of fourth order in the angle of the ray

    detector : of the camera;  exposure : what its tilt is keyed by;  seed : of the request
    """
    wheel = detector.wheel
    if wheel is None or not wheel.error:
        return detector
    stream = rng.stream(seed, "filter_wheel", exposure)
    across, up = (float(part) for part in stream.normal(0.0, wheel.error * 0.5**0.5, 2))
    return displaced(detector, across, up)


def displaced(detector: Detector, across: float, up: float) -> Detector:
    """The same for a tilt (rad) by which the filter's normal leans along the focal plane's x and y axes.

    A place of the detector sees what, without the tilt, is seen so much before it.
    detector : of the camera;  across, up : of the tilt
    """
    wheel = detector.wheel
    if wheel is None:
        return detector
    shift, bend = wheel.shift, wheel.bend * ARCSEC**2
    own = (
        (2, 0, -3.0 * bend * across, -bend * up),
        (1, 1, -2.0 * bend * up, -2.0 * bend * across),
        (0, 2, -bend * across, -3.0 * bend * up),
    )
    bending = distortion.joined(detector.bending, own)
    return replace(detector, x=detector.x - shift * across, y=detector.y - shift * up, bending=bending)
