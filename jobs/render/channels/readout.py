"""What a detector is read out as: arrays, each with its unit and cards, whatever the camera.

frame       one array of pixels
quadrants   four of them, each in the detector's own axes with its pre- and overscan
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from astropy.wcs import WCS

from jobs.render.camera import astrometry
from jobs.render.effects.readout import quadrants as layout
from jobs.render.effects.scene import Frame, Scene
from lake_schema.arrays import Array
from lake_schema.fits.images import Card


@dataclass(frozen=True, slots=True)
class Extension:
    """An array of a readout: its dtype is the file's.

    name  : of its extension; "" = the only array of its file
    cards : of it alone
    """

    name: str
    data: Array
    cards: tuple[Card, ...] = ()


@dataclass(frozen=True, slots=True)
class Readout:
    """The arrays of a detector.

    raw     : as the last effect leaves them, in readout order
    pixels  : [ny, nx] those of the detector alone, in its own axes
    unit    : of all arrays, as FITS writes it
    cards   : for all arrays
    """

    extensions: tuple[Extension, ...]
    raw: Array
    pixels: Array
    unit: str
    cards: tuple[Card, ...] = ()


def frame(found: Frame, scene: Scene, detector: str, system: WCS) -> Readout:
    """A detector that is read as one frame: uint16[ny, nx] ADU.

    found    : ADU of the detector;  scene : what it was rendered with
    detector : its name;  system : its world coordinates
    """
    raw = found.astype(np.uint16)
    return Readout((Extension("", raw),), raw, raw, "adu")


def quadrants(found: Frame, scene: Scene, detector: str, system: WCS) -> Readout:
    """A detector that is read in quadrants [4, rows, columns]: uint16 ADU, extensions named detector.quadrant.

    found    : ADU of the quadrants;  scene : what they were rendered with
    detector : its name;  system : its world coordinates
    """
    raw = found.astype(np.uint16)
    prescan, overscan, rows, middle = sizes = layout.sizes(scene)
    scans = (
        ("PRESCAN", prescan, "[pix] columns before the pixels"),
        ("OVERSCAN", overscan, "[pix] columns after the pixels"),
        ("OVERROWS", rows, "[pix] rows after the pixels"),
        ("INJROWS", middle, "[pix] rows between the halves, without pixels"),
    )  # fmt: skip
    extensions = []
    for number, name in enumerate(layout.NAMES):
        # Of the detector's first pixel in the extension, from 0.
        across, up = layout.origin(number, raw[number].shape, *sizes)
        place = astrometry.cards(astrometry.shifted(system, across, up))
        cards: tuple[Card, ...] = (("QUADRANT", name, "quadrant"), *scans, *place)
        extensions.append(Extension(f"{detector}.{name}", layout.placed(raw[number], number), cards))
    pixels: npt.NDArray[np.uint16] = layout.assembled(raw, *sizes)
    return Readout(tuple(extensions), raw, pixels, "adu", scans)
