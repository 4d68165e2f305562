"""Convert ellipticities of the common conventions to axis ratio and position angle.

A galaxy with axis ratio q = b/a, whose major axis is at the angle phi from the first axis of the frame towards the
second one, has the ellipticity (e1, e2) = |e| (cos 2 phi, sin 2 phi). The conventions differ in |e|:

=============  =========================  ==========================  ==================
convention     |e|                        q                           name in GalSim
=============  =========================  ==========================  ==================
"shear"        (1 - q) / (1 + q)          (1 - |e|) / (1 + |e|)       g1, g2
"distortion"   (1 - q^2) / (1 + q^2)      sqrt((1-|e|) / (1+|e|))     e1, e2
"conformal"    -ln q                      exp(-|e|)                   eta1, eta2
"flattening"   1 - q                      1 - |e|                     (none)
=============  =========================  ==========================  ==================
"""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float

CONVENTIONS = ("shear", "distortion", "conformal", "flattening")
# Frames of ellipticities, named by the directions of the first and the second axis on the sky: the position angle (from
# north through east, deg) of the major axis is start + sign * phi.
_FRAMES = {"east_north": (90.0, -1.0), "west_north": (-90.0, 1.0), "north_east": (0.0, 1.0), "north_west": (0.0, -1.0)}
FRAMES = tuple(_FRAMES)


def largest(convention: str, axis_ratio: float) -> float:
    """Return the |e| that belongs to an axis ratio; `convention` is one of `CONVENTIONS`."""
    q = axis_ratio
    values = {
        "shear": (1.0 - q) / (1.0 + q),
        "distortion": (1.0 - q * q) / (1.0 + q * q),
        "conformal": -np.log(q),
        "flattening": 1.0 - q,
    }
    return float(values[convention])


def axis_ratio(convention: str, e1: Float, e2: Float) -> Float:
    """Return the axis ratio b/a of galaxies.

    Parameters
    ----------
    convention : str
        Convention of the ellipticities, one of `CONVENTIONS`.
    e1, e2 : float array, shape (n,)
        Components of the ellipticities.

    Returns
    -------
    float array, shape (n,)
        Axis ratios; NaN or below 0 if |e| is larger than the convention allows.
    """
    size = np.hypot(e1, e2)
    with np.errstate(invalid="ignore"):
        if convention == "conformal":
            return np.asarray(np.exp(-size))
        if convention == "flattening":
            return np.asarray(1.0 - size)
        ratio = (1.0 - size) / (1.0 + size)
        return np.asarray(ratio if convention == "shear" else np.sqrt(ratio))


def position_angle(frame: str, e1: Float, e2: Float) -> Float:
    """Return the position angle of the major axes of galaxies, in deg from north through east, from -180 to 180.

    Parameters
    ----------
    frame : str
        Directions of the axes of the frame, one of `FRAMES`.
    e1, e2 : float array, shape (n,)
        Components of the ellipticities in this frame.

    Returns
    -------
    float array, shape (n,)
        Position angles.
    """
    start, sign = _FRAMES[frame]
    return np.asarray(start + sign * 0.5 * np.degrees(np.arctan2(e2, e1)))
