"""What a point source is on a frame's detector.

profile      the PSF in its middle
enclosed     the part of a point source's light in an aperture
"""

from __future__ import annotations

from typing import Any

import numpy as np
import sep

from truesky.reduction.frames import Frame
from truesky.render.channels import registry
from truesky.render.psf import from_file

# Places on a detector at which its PSF is known; the middle one is taken.
_POSITIONS = 1


def profile(frame: Frame) -> Any:
    """galsim object in the detector's axes, without the pixel: the PSF in the middle of a frame's detector."""
    scene, exposure = frame.scene, frame.exposure
    assert scene.detector is not None
    assert scene.band is not None
    if exposure.psf:
        file = from_file.path_for_detector(exposure.psf, frame.detector)
        return from_file.read(file, scene.detector, scene.band).profile
    channel = registry.find_channel(exposure.channel, exposure.image_type, f"exposure {exposure.exposure_id}")
    return channel.psf(exposure, scene.detector, scene.band, scene.mission, _POSITIONS).profile


def enclosed_fraction(psf: Any, scale: float, radius: float) -> float:
    """Part of a point source's light in a circle about it.

    psf : galsim object, without the pixel;  scale : arcsec a pixel;  radius : pixels
    """
    side = 2 * int(np.ceil(radius)) + 5
    image = psf.drawImage(nx=side, ny=side, scale=scale, dtype=float).array
    middle = [side // 2]
    return float(sep.sum_circle(np.ascontiguousarray(image), middle, middle, radius, subpix=0)[0][0])
