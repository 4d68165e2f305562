"""Return the PSF that was used to simulate a frame, and the fraction of its light in an aperture."""

from __future__ import annotations

from typing import Any

import numpy as np
import sep

from truesky.reduction.frames import Frame
from truesky.render.camera import astrometry
from truesky.render.channels import registry
from truesky.render.psf import from_file

# Number of positions on a detector for which the PSF is computed from mission parameters; 1 means only the centre.
_POSITIONS = 1


def profile(frame: Frame) -> Any:
    """Return the PSF at the centre of a frame's detector as a galsim object, in arcsec along the detector's axes.

    The PSF is not convolved with the pixel. It is read from the PSF file of the exposure, if it has one, and otherwise
    computed from the mission parameters.
    """
    scene, exposure = frame.scene, frame.exposure
    assert scene.detector is not None
    assert scene.band is not None
    if exposure.psf:
        file = from_file.path_for_detector(exposure.psf, frame.detector)
        system = astrometry.wcs(scene.detector, exposure.ra, exposure.dec, exposure.position_angle)
        return from_file.read(file, scene.detector, scene.band, system).profile
    channel = registry.find_channel(exposure.channel, exposure.image_type, f"exposure {exposure.exposure_id}")
    return channel.psf(exposure, scene.detector, scene.band, scene.mission, _POSITIONS).profile


def enclosed_fraction(psf: Any, scale: float, radius: float) -> float:
    """Return the fraction of a point source's light in a circular aperture.

    Parameters
    ----------
    psf : galsim object
        PSF not convolved with the pixel, with a total flux of 1.
    scale : float
        Pixel scale in arcsec.
    radius : float
        Radius of the aperture in pixels, centred on the source.

    Returns
    -------
    float
        Fraction of the light, 0 to 1.
    """
    side = 2 * int(np.ceil(radius)) + 5
    image = psf.drawImage(nx=side, ny=side, scale=scale, dtype=float).array
    middle = [side // 2]
    return float(sep.sum_circle(np.ascontiguousarray(image), middle, middle, radius, subpix=0)[0][0])
