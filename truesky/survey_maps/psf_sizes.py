"""Effective area and FWHM of the PSF of planned exposures, from the PSF models with which images are rendered.

The effective area is 1 / integral of P^2 dA, with the PSF P including the pixel's response. It is the area of blank sky
whose noise equals that of a point source measured with the best weights (King 1983, PASP 95, 163). Wings and
diffraction rings make it larger than that of a Gaussian with the same FWHM.

In space the PSF depends on the position (x, y) in the focal plane. The logarithms of area and FWHM are the sums of
terms in 1, x, y, x y and x^2 + y^2 through the detectors in the middle and in the corners. Individual differences
between the other detectors (rms 1.8 % of the area in VIS, at most 5.6 %) are neglected. From the ground the PSF
depends on seeing and airmass. The logarithms are interpolated between nodes in the ranges of the plan: with a
quadratic polynomial in the logarithm of seeing airmass^0.6, and linearly in the airmass. The differences between
detectors of a ground camera (0.3 to 2 % of the area) are neglected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from lake_schema.arrays import Float
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes.passbands import Passband
from truesky.numerics import matrices
from truesky.numerics.cache import cached_arrays, content_key
from truesky.numerics.code_fingerprints import code_key
from truesky.render.camera import detectors as camera_detectors
from truesky.render.camera.detectors import Detector
from truesky.render.channels import registry
from truesky.render.channels.aim import Aim
from truesky.render.exposure import scene_factory
from truesky.render.psf import from_file, pixel_response
from truesky.render.psf.model import Psf
from truesky.request.accuracy import SURVEY

# Exponent of the airmass in the FWHM of seeing (Roddier 1981).
_AIRMASS_POWER = 0.6
# Nodes in the logarithm of the seeing.
_SEEING_NODES = 3
# Ranges of the logarithm of the seeing, and of the airmass, up to which one node suffices.
_NARROW = 1e-6
# Cameras with at most this number of detectors have no interpolation between detectors.
_FEW = 5
# Side of the image, in pixels, on which PSFs without planes are drawn.
_SIDE = 128
# Samples per pixel of that image.
_SAMPLES = 4


@dataclass(frozen=True, slots=True)
class AirRange:
    """Ranges of seeing airmass^0.6 (arcsec) and of the airmass of the exposures in a band of a ground camera."""

    seeing: tuple[float, float]
    airmass: tuple[float, float]


def effective_area(psf: Psf, strength: float = 0.0) -> float:
    """Return the effective area of a PSF for a source with constant f_nu, arcsec^2.

    Parameters
    ----------
    psf : Psf
        The PSF.
    strength : float
        Parameter a of the response 1 - a (u^2 + v^2) inside a pixel, 0 to 0.5. It is ignored if the PSF already
        includes the pixel.

    Returns
    -------
    float
        1 / integral of the square of the PSF. The PSF is normalised to the light of the source, so the light that
        the PSF image loses makes the area larger.
    """
    if psf.planes is not None:
        image, samples = psf.planes.images.mean(axis=0, dtype=float), psf.planes.samples
    else:
        samples = _SAMPLES
        side = _SIDE * samples + 1
        scale = psf.pixel_scale / samples
        image = psf.profile.drawImage(nx=side, ny=side, scale=scale, method="no_pixel", dtype=float).array
    size = scipy.fft.next_fast_len(len(image) + 2 * samples, real=True)
    power = np.abs(scipy.fft.rfft2(image, (size, size))) ** 2
    if psf.intra_pixel is not None:
        fy, fx = np.fft.fftfreq(size) * samples, np.fft.rfftfreq(size) * samples
        power *= pixel_response.transform(fx[None], fy[:, None], strength) ** 2
    # The transform of a real image is stored for half of the plane: count the columns of the other half.
    twice = np.full(power.shape[1], 2.0)
    twice[0] = 1.0
    if size % 2 == 0:
        twice[-1] = 1.0
    total = float((power * twice).sum()) / size**2
    return float((psf.pixel_scale / samples) ** 2 / total)


def air_coordinates(exposures: Sequence[ExposureRow]) -> tuple[Float, Float]:
    """Return seeing airmass^0.6 (arcsec) and the airmass of exposures, arrays of shape (n,)."""
    airmass = np.array([1.0 if e.airmass is None else e.airmass for e in exposures])
    return np.array([e.seeing for e in exposures]) * airmass**_AIRMASS_POWER, airmass


def in_air(
    exposures: Sequence[ExposureRow], ranges: AirRange, band: Passband, mission: MissionConfiguration
) -> tuple[Float, Float]:
    """Return the effective area of the PSF (arcsec^2) and its FWHM (arcsec) for exposures of a ground camera.

    Parameters
    ----------
    exposures : sequence of ExposureRow
        Exposures of one camera in one band, with the same mission parameters.
    ranges : AirRange
        Ranges of the whole plan, which determine the nodes, so that all processes have the same ones.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    area, fwhm : float array, shape (n,)
        Values of each exposure.
    """
    low, high = (float(end) for end in np.log(ranges.seeing))
    # Values that differ by rounding only have one node: the polynomial between two such nodes is not a number.
    seeing = np.linspace(low, high, _SEEING_NODES) if high - low > _NARROW else np.array([low])
    airmass = np.array(ranges.airmass if np.ptp(ranges.airmass) > _NARROW else ranges.airmass[:1])
    middle = _middle(camera_detectors.detectors(exposures[0].camera, mission))
    # The air of an exposure has a random elongation, which its place and date select. Nodes have one place and date, so
    # that they do not depend on the exposure that a process reads first.
    node = replace(exposures[0], ra=0.0, dec=0.0, mjd=0.0, zenith=None)
    nodes = [
        replace(node, seeing=float(np.exp(s)) / float(x) ** _AIRMASS_POWER, airmass=float(x))
        for s in seeing
        for x in airmass
    ]
    logs = np.log([_cached_sizes(node, middle, band, mission, 0) for node in nodes])
    table = logs.reshape(len(seeing), len(airmass), 2)
    at_seeing, at_airmass = air_coordinates(exposures)
    weights = _lagrange(seeing, np.log(at_seeing))[:, :, None] * _lagrange(airmass, at_airmass)[:, None, :]
    values = np.exp((weights[..., None] * table).sum(axis=(1, 2)))
    return values[:, 0], values[:, 1]


def in_field(
    exposure: ExposureRow, band: Passband, mission: MissionConfiguration, seed: int
) -> dict[str, tuple[float, float]]:
    """Return the effective area of the PSF (arcsec^2) and its FWHM (arcsec) by the name of the detector.

    Parameters
    ----------
    exposure : ExposureRow
        Exposure in space, or with a PSF file of the user.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database.
    seed : int
        Seed of the request, for the positions of the detectors.

    Returns
    -------
    dict of str to (float, float)
        Area and FWHM for each detector of the camera.
    """
    all_detectors = camera_detectors.detectors(exposure.camera, mission)
    x, y = (np.array([getattr(detector, axis) for detector in all_detectors]) for axis in "xy")
    x, y = (values / max(float(np.abs(values).max()), 1.0) for values in (x, y))
    if len(all_detectors) <= _FEW:
        chosen = list(range(len(all_detectors)))
    else:
        places = ((0, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))
        chosen = [int(np.argmin((x - u) ** 2 + (y - v) ** 2)) for u, v in places]
    sizes = np.log([_cached_sizes(exposure, all_detectors[i], band, mission, seed) for i in chosen])
    if len(all_detectors) <= _FEW:
        values = sizes
    else:
        basis = np.stack([np.ones_like(x), x, y, x * y, x * x + y * y], axis=1)
        values = matrices.matmul(basis, matrices.least_squares(basis[chosen], sizes))
    return {d.name: (float(np.exp(v[0])), float(np.exp(v[1]))) for d, v in zip(all_detectors, values, strict=True)}


def sizes(
    exposure: ExposureRow, detector: Detector, band: Passband, mission: MissionConfiguration, seed: int
) -> tuple[float, float]:
    """Return the effective area (arcsec^2) and the FWHM (arcsec) of the PSF in the middle of a detector.

    Parameters
    ----------
    exposure : ExposureRow
        The exposure.
    detector : Detector
        Detector of its camera.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database.
    seed : int
        Seed of the request, for the position of the detector on the sky, in which a user's PSF may be given.

    Returns
    -------
    area, fwhm : float
        Values with the average over the pixel.
    """
    channel = registry.CHANNELS[exposure.channel]
    if exposure.psf:
        aim = Aim.from_exposure(exposure, detector, band, seed)
        psf = from_file.read(from_file.path_for_detector(exposure.psf, detector.name), detector, band, aim.wcs)
    else:
        psf = channel.psf(exposure, detector, band, mission, 1)
    strength = 0.0
    if channel.transfer_effect is not None:
        scene = scene_factory.from_exposure(exposure, detector, mission, SURVEY)
        (strength,) = channel.transfer_effect.parameters(scene)
    return effective_area(psf, strength), psf.fwhm


def _cached_sizes(*arguments: Any) -> tuple[float, float]:
    """Return the result of `sizes` for its arguments, from the cache on disc or computed now."""
    exposure, detector, band, mission, _ = arguments
    if exposure.psf:
        return sizes(*arguments)
    optics = (exposure.channel, exposure.camera, exposure.band, exposure.seeing, exposure.airmass)
    curve = (band.wavelength, band.response)
    key = content_key(code_key(__name__), repr((optics, detector)), mission.fingerprint, *curve)
    area, fwhm = cached_arrays("depth_psf", key, lambda: {"sizes": np.array(sizes(*arguments))})["sizes"].tolist()
    return area, fwhm


def _middle(all_detectors: Sequence[Detector]) -> Detector:
    return min(all_detectors, key=lambda detector: (round(np.hypot(detector.x, detector.y), 3), detector.name))


def _lagrange(nodes: Float, places: Float) -> Float:
    """Return the weights of the values at the nodes in the polynomial through them, shape (places, nodes)."""
    weights = np.ones((len(places), len(nodes)))
    for i, node in enumerate(nodes):
        for other in np.delete(nodes, i):
            weights[:, i] *= (places - other) / (node - other)
    return weights
