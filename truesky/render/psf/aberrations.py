"""Transfer function of a ground telescope's optics, for the small pupil distances that turbulent air transmits."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import galsim
import numpy as np
import scipy.fft

from lake_schema.arrays import Complex, Float
from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import MissionConfiguration

# Largest distance in the pupil, in Fried lengths; the air transmits little beyond it.
FARTHEST = 3.0
# Samples across the pupil; samples of the transform for its overlaps; steps of the lattice up to FARTHEST.
_ACROSS, _TRANSFORM, _LATTICE = 120, 256, 10
# Distance at which the phase gives the centroid of the light, m.
_CENTROID_LAG = 0.06


@dataclass(frozen=True, slots=True)
class Telescope:
    """Properties of a telescope and its site that are the same in all exposures.

    Attributes
    ----------
    radius, inner : float
        Outer and inner radius of the clear ring of the pupil, m.
    outer : float
        Outer scale of the turbulence, m.
    """

    radius: float
    inner: float
    outer: float

    @classmethod
    def from_mission(cls, section: str, mission: MissionConfiguration) -> Telescope:
        """Read a camera's section of the mission database; the obscured area is assumed to be a central circle.

        Raises
        ------
        OutOfRange
            If the collecting area is not positive or exceeds the aperture.
        """
        radius = 0.5 * mission.value(f"{section}.aperture_diameter", "m")
        area = mission.value(f"{section}.collecting_area", "m2")
        if not 0.0 < area <= np.pi * radius**2:
            raise OutOfRange(f"mission parameter {section}.collecting_area, m2", area, 0.0, np.pi * radius**2)
        inner = float(np.sqrt(max(radius**2 - area / np.pi, 0.0)))
        return cls(radius, inner, mission.value(f"{section}.psf.outer_scale", "m"))


@dataclass(frozen=True, slots=True)
class TransferRatio:
    """Transfer function of the optics, divided by that without aberrations.

    Attributes
    ----------
    values : complex array, shape (2 m + 1, 2 m + 1)
        The ratio on a lattice of distances in the pupil.
    step : float
        Spacing of the lattice, m.
    """

    values: Complex
    step: float

    @classmethod
    def from_wavefront(cls, nm: Float, telescope: Telescope, wave: float, fried: float, turn: float) -> TransferRatio:
        """Compute the ratio for a wavefront, without the tilt that moves the centroid.

        Parameters
        ----------
        nm : float array
            Coefficients by Noll number, nm.
        telescope : Telescope
            The telescope.
        wave : float
            Wavelength, Angstrom.
        fried : float
            Fried length, m.
        turn : float
            Rotation of the axes, radian.

        Returns
        -------
        TransferRatio
            The ratio.
        """
        step = 2.0 * telescope.radius / _ACROSS
        stride = max(int(np.ceil(FARTHEST * fried / (_LATTICE * step))), 1)
        lags = stride * (np.arange(2 * _LATTICE + 3) - _LATTICE - 1)
        x, y, clear, plain = _pupil(telescope.radius, telescope.inner)
        x, y = np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y
        phase = galsim.zernike.Zernike(nm * (20.0 * np.pi / wave))(x, y)
        field = scipy.fft.fft2(clear * np.exp(1j * phase), (_TRANSFORM, _TRANSFORM))
        overlap = scipy.fft.ifft2(np.abs(field) ** 2)[np.ix_(lags, lags)]
        values = overlap / plain[np.ix_(lags, lags)]
        lag_steps = max(round(_CENTROID_LAG / (stride * step)), 1)
        middle, along = _LATTICE + 1, stride * step * (np.arange(len(lags)) - _LATTICE - 1)
        tilts = [
            float(np.angle(v)) / (lag_steps * stride * step)
            for v in (values[middle, middle + lag_steps], values[middle + lag_steps, middle])
        ]
        values = values * np.exp(-1j * (tilts[0] * along + tilts[1] * along[:, None]))
        return cls(values, stride * step)


@lru_cache(maxsize=8)
def _pupil(radius: float, inner: float) -> tuple[Float, Float, Float, Float]:
    """Positions x, y in radii and transmission [n, n] of the pupil, and its overlap with itself by lags."""
    step = 2.0 / _ACROSS
    axis = (np.arange(_ACROSS + 4) - (_ACROSS + 3) / 2) * step
    x, y = np.meshgrid(axis, axis)
    r = np.hypot(x, y)
    clear = np.clip(0.5 + (1.0 - r) / step, 0.0, 1.0) * np.clip(0.5 + (r - inner / radius) / step, 0.0, 1.0)
    overlap = scipy.fft.irfft2(np.abs(scipy.fft.rfft2(clear, (_TRANSFORM, _TRANSFORM))) ** 2)
    return x, y, clear, np.asarray(overlap)


def ideal_transfer(distance: Float, radius: float, inner: float) -> Float:
    """Transfer function of perfect optics: the overlap of a ring with itself after a shift, divided by its area.

    Parameters
    ----------
    distance : float array
        Shift, m.
    radius, inner : float
        Outer and inner radius of the ring, m.

    Returns
    -------
    float array
        Transfer function, 0 to 1.
    """
    area = np.pi * (radius**2 - inner**2)
    overlap = (
        _circle_overlap(distance, radius, radius)
        - 2.0 * _circle_overlap(distance, radius, inner)
        + _circle_overlap(distance, inner, inner)
    )
    return np.asarray(overlap / area)


def _circle_overlap(distance: Float, first_radius: float, second_radius: float) -> Float:
    """Common area of two circles whose centres are a distance apart."""
    small = min(first_radius, second_radius)
    if small == 0.0:
        return np.zeros_like(distance)
    d = np.clip(distance, max(abs(first_radius - second_radius), 1e-12), first_radius + second_radius)
    a, b = (
        (d * d + first_radius**2 - second_radius**2) / (2.0 * d * first_radius),
        (d * d + second_radius**2 - first_radius**2) / (2.0 * d * second_radius),
    )
    rim = np.maximum(
        (first_radius + second_radius - d)
        * (d + first_radius - second_radius)
        * (d - first_radius + second_radius)
        * (d + first_radius + second_radius),
        0.0,
    )
    area = (
        first_radius**2 * np.arccos(np.clip(a, -1.0, 1.0))
        + second_radius**2 * np.arccos(np.clip(b, -1.0, 1.0))
        - 0.5 * np.sqrt(rim)
    )
    return np.asarray(np.where(distance <= abs(first_radius - second_radius), np.pi * small**2, area))
