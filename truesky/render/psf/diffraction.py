"""Diffraction at the pupil of Euclid's telescope: the image of a point source through its optics, before any blur."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy

from lake_schema.arrays import Float, Float32
from lake_schema.mission.configuration import MissionConfiguration
from truesky.render.psf import zernikes

# Radian per arcsec.
_ARCSEC = np.pi / 180.0 / 3600.0


def pupil(x: Float, y: Float, softness: float, mission: MissionConfiguration) -> Float:
    """Return the transmission of Euclid's entrance pupil: aperture stop, decentred central stop, three spider bars.

    Parameters
    ----------
    x, y : float array, same shape
        Positions in the pupil relative to the centre of the aperture, mm.
    softness : float
        Width over which the transmission changes from 0 to 1 at an edge, mm. If it equals the spacing of the positions,
        the transmission is approximately averaged over the square around each position.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras).

    Returns
    -------
    float array
        Transmission, 0 to 1.
    """
    radius = 0.5 * mission.value("plm.aperture_diameter", "mm")
    stop, stop_y = mission.value("plm.pupil.stop_radius", "mm"), mission.value("plm.pupil.stop_y", "mm")
    clear = _step(radius - np.hypot(x, y), softness) * _step(np.hypot(x, y - stop_y) - stop, softness)
    width = mission.value("plm.pupil.spider_width", "mm")
    reach = mission.value("plm.pupil.spider_half_length", "mm")
    for bar in ("spider1", "spider2", "spider3"):
        bar_x, bar_y = mission.value(f"plm.pupil.{bar}.x", "mm"), mission.value(f"plm.pupil.{bar}.y", "mm")
        angle = mission.value(f"plm.pupil.{bar}.angle", "rad")
        # Distance of each position from the axis of the spider bar, mm. It is computed from the angle of the bar, since
        # the slope would be infinite for a bar along y.
        across = np.abs(-np.sin(angle) * (x - bar_x) + np.cos(angle) * (y - bar_y))
        blocked = _step(width / 2 - across, softness) * _step(reach - np.hypot(x - bar_x, y - bar_y), softness)
        clear = clear * (1.0 - blocked)
    return np.asarray(clear)


def _step(depth: Float, softness: float) -> Float:
    return np.clip(0.5 + depth / softness, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Optics:
    """The pupil of Euclid's telescope, sampled for the computation of the PSF at one wavelength.

    Attributes
    ----------
    transform : int
        Side of the Fourier transform from the pupil to the image, samples.
    transmission : float array, shape (n, n)
        Transmission of the pupil, 0 to 1.
    x, y : float array, shape (m,)
        Positions of the m samples with a transmission above 0, from the centre of the pupil in units of its radius.
    wavelength : float
        Wavelength, Angstrom.
    """

    transform: int
    transmission: Float
    x: Float
    y: Float
    wavelength: float


def optics_of(wavelength: float, sampling: float, mission: MissionConfiguration, transform: int) -> Optics:
    """Sample the pupil with a spacing for which the PSF image at a given wavelength has a given spacing of samples.

    Parameters
    ----------
    wavelength : float
        Wavelength, Angstrom.
    sampling : float
        Spacing of the samples of the image, arcsec.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras).
    transform : int
        Side of the Fourier transform from the pupil to the image, samples.

    Returns
    -------
    Optics
        The sampled pupil, whose transmission changes over one sample at the edges.
    """
    step = wavelength * 1e-7 / (transform * sampling * _ARCSEC)
    radius = 0.5 * mission.value("plm.aperture_diameter", "mm")
    n = 2 * (int(np.ceil(radius / step)) + 1)
    axis = (np.arange(n) - n // 2) * step
    x, y = np.meshgrid(axis, axis)
    transmission = pupil(x, y, step, mission)
    lit = transmission > 0
    return Optics(transform, transmission, x[lit] / radius, y[lit] / radius, wavelength)


def diffraction_image(nm: Float, optics: Optics, side: int | None = None) -> Float32:
    """Return the image of a point source through aberrated optics: the squared modulus of the pupil's transform.

    Parameters
    ----------
    nm : float array, shape (z,)
        Zernike coefficients of the wavefront, nm rms; the index is the Noll number.
    optics : Optics
        The sampled pupil.
    side : int, optional
        Side of the result about its middle sample, samples; by default that of the whole transform.

    Returns
    -------
    float32 array, shape (side, side)
        Image centred on sample side // 2. The flux over the whole sky is 1, so the sum of the image is below 1. The
        sampled pupil has soft edges, which weaken light far from the centre; this is corrected. Because of single
        precision, the relative error per sample is 5e-4, and 5e-6 in the core.
    """
    transmission, transform = optics.transmission, optics.transform
    side = transform if side is None else side
    lit = transmission > 0
    scaled = nm * (2 * np.pi / (optics.wavelength / 10.0))
    phase = zernikes.sum_of_zernikes(scaled, optics.x, optics.y).astype(np.float32)
    field = np.zeros(transmission.shape, np.complex64)
    field.real[lit] = transmission[lit] * np.cos(phase)
    field.imag[lit] = transmission[lit] * np.sin(phase)
    middle = (np.arange(side) - side // 2) % transform
    # The inverse Fourier transform along rows is done first. Then the transform along columns is needed only for those
    # columns that are part of the result.
    lines = scipy.fft.ifft(field, transform, axis=1, overwrite_x=True)[:, middle]
    parts = scipy.fft.ifft(lines, transform, axis=0, overwrite_x=True)[middle].view(np.float32)
    parts *= parts
    power = parts[:, 0::2] + parts[:, 1::2]
    power *= _edge_gain(transform, side)
    power *= np.float32(transform**2 / transmission.sum())
    return np.asarray(power)


@lru_cache(maxsize=4)
def _edge_gain(transform: int, side: int) -> Float32:
    """Return the factors [side, side] that correct the light in a diffraction image for the soft edges of the pupil.

    The sampled pupil has edges over which the transmission changes gradually. This multiplies the light at a distance
    of r samples from the middle by approximately sinc^2(r / transform), where `transform` is the number of samples per
    side of the Fourier transform. The factors are the inverse of this.
    """
    angle = (np.arange(side) - side // 2) / transform
    return np.asarray(np.sinc(np.hypot(angle[:, None], angle)) ** -2.0, np.float32)
