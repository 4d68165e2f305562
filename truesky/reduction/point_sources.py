"""Model point sources on a frame's detector."""

from __future__ import annotations

from typing import Any

import numpy as np
import sep

from truesky.reduction.frames import Frame
from truesky.render.channels import registry
from truesky.render.psf import from_file

# Number of positions on a detector at which the PSF is computed.
_POSITIONS = 1


def profile(frame: Frame) -> Any:
    """Return the PSF at the centre of a frame's detector, a galsim object in the detector's axes without the pixel."""
    scene, exposure = frame.scene, frame.exposure
    assert scene.detector is not None
    assert scene.band is not None
    if exposure.psf:
        file = from_file.path_for_detector(exposure.psf, frame.detector)
        return from_file.read(file, scene.detector, scene.band).profile
    channel = registry.find_channel(exposure.channel, exposure.image_type, f"exposure {exposure.exposure_id}")
    return channel.psf(exposure, scene.detector, scene.band, scene.mission, _POSITIONS).profile


def enclosed_fraction(psf: Any, scale: float, radius: float) -> float:
    """Return the fraction of a point source's light in a circular aperture.

    Parameters
    ----------
    psf : galsim object
        PSF without the pixel.
    scale : float
        Pixel scale in arcsec.
    radius : float
        Radius of the aperture in pixels.

    Returns
    -------
    float
        Fraction of the light.
    """
    side = 2 * int(np.ceil(radius)) + 5
    image = psf.drawImage(nx=side, ny=side, scale=scale, dtype=float).array
    middle = [side // 2]
    return float(sep.sum_circle(np.ascontiguousarray(image), middle, middle, radius, subpix=0)[0][0])
