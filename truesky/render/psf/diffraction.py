"""Diffraction at the pupil of Euclid's telescope: the image of a point source through its optics, before any blur."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import galsim
import numpy as np
import scipy.fft

from lake_schema.arrays import Float, Float32
from lake_schema.mission.configuration import MissionConfiguration

_ARCSEC = np.pi / 180.0 / 3600.0


def pupil(x: Float, y: Float, softness: float, mission: MissionConfiguration) -> Float:
    """Transmission of the entrance pupil: aperture stop, decentred central stop, three spider bars.

    Parameters
    ----------
    x, y : float array
        Positions in the pupil, mm.
    softness : float
        Width of the edges, mm. With a width of one sample, edges cover their pixels by area.
    mission : MissionConfiguration
        Mission database.

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
        # The normal form of a line has no singular angle.
        across = np.abs(-np.sin(angle) * (x - bar_x) + np.cos(angle) * (y - bar_y))
        blocked = _step(width / 2 - across, softness) * _step(reach - np.hypot(x - bar_x, y - bar_y), softness)
        clear = clear * (1.0 - blocked)
    return np.asarray(clear)


def _step(depth: Float, softness: float) -> Float:
    return np.clip(0.5 + depth / softness, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Optics:
    """The pupil, sampled for a wavelength.

    Attributes
    ----------
    transform : int
        Side of the optical transform, samples.
    transmission : float array, shape (n, n)
        Transmission of the pupil.
    x, y : float array
        Positions of the samples that transmit light, in radii of the pupil.
    wavelength : float
        Wavelength, Angstrom.
    """

    transform: int
    transmission: Float
    x: Float
    y: Float
    wavelength: float


def optics_of(wavelength: float, sampling: float, mission: MissionConfiguration, transform: int) -> Optics:
    """Sample the pupil for a wavelength, so that the sampling of the image does not depend on the wavelength.

    Parameters
    ----------
    wavelength : float
        Wavelength, Angstrom.
    sampling : float
        Sampling of the image, arcsec.
    mission : MissionConfiguration
        Mission database.
    transform : int
        Side of the image, samples.

    Returns
    -------
    Optics
        The sampled pupil; its edges are one sample wide.
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
    """Image of a point source through a wavefront, |FFT of the pupil|^2.

    Parameters
    ----------
    nm : float array
        Wavefront by Noll number, nm.
    optics : Optics
        The sampled pupil.
    side : int, optional
        Side of the result about the middle, samples; by default that of the whole transform.

    Returns
    -------
    float32 array, shape (side, side)
        Image with unit flux over the whole sky, corrected for the loss by soft edges. Because of single precision, the
        relative error per sample is 5e-4, and 5e-6 in the core.
    """
    transmission, transform = optics.transmission, optics.transform
    side = transform if side is None else side
    lit = transmission > 0
    phase = galsim.zernike.Zernike(nm * (2 * np.pi / (optics.wavelength / 10.0)))(optics.x, optics.y).astype(np.float32)
    field = np.zeros(transmission.shape, np.complex64)
    field.real[lit] = transmission[lit] * np.cos(phase)
    field.imag[lit] = transmission[lit] * np.sin(phase)
    middle = (np.arange(side) - side // 2) % transform
    # Rows with light are transformed first, and then only the columns in the result.
    lines = scipy.fft.ifft(field, transform, axis=1, overwrite_x=True)[:, middle]
    parts = scipy.fft.ifft(lines, transform, axis=0, overwrite_x=True)[middle].view(np.float32)
    parts *= parts
    power = parts[:, 0::2] + parts[:, 1::2]
    power *= _edge_gain(transform, side)
    power *= np.float32(transform**2 / transmission.sum())
    return np.asarray(power)


@lru_cache(maxsize=4)
def _edge_gain(transform: int, side: int) -> Float32:
    """Inverse of the fraction of diffracted light that soft edges leave, by angle: 1 / sinc^2(angle / side)."""
    angle = (np.arange(side) - side // 2) / transform
    return np.asarray(np.sinc(np.hypot(angle[:, None], angle)) ** -2.0, np.float32)
