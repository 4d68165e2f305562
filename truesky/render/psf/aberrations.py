"""Transfer function of the optics of a ground telescope with aberrations, in images through turbulent air.

The value of a transfer function at a spatial frequency is determined by pairs of points in the pupil. The distance of
the two points (m) is the wavelength (m) times the frequency (cycles per radian). Turbulent air transmits only
frequencies that belong to small distances, so the transfer function of the optics is computed only for these.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy

from lake_schema.arrays import Complex, Float
from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import MissionConfiguration
from truesky.render.psf import zernikes

# Largest distance of two points in the pupil (wavelength times spatial frequency) for which the transfer function of
# the optics is computed, in Fried lengths. At larger distances the air transmits little, and the light is neglected.
FARTHEST = 3.0
# Number of samples across the diameter of the pupil.
_ACROSS = 120
# Number of samples per side of the Fourier transform by which the pupil is correlated with a shifted copy of itself. It
# is more than twice `_ACROSS`, so that the periodic copies do not overlap.
_TRANSFORM = 256
# Number of steps, from 0 to at least FARTHEST along one axis, of the lattice of shifts in the pupil at which the
# transfer function of the optics is computed. One more step is added at each end. A step is a multiple of the spacing
# of the pupil's samples.
_LATTICE = 10
# Shift in the pupil, m, near which the phase of the optics' transfer function is measured: at the nearest shift of the
# lattice other than 0. The phase divided by the shift gives the displacement of the image's centroid by aberrations.
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
        """Read a telescope from the mission database (parameters of telescopes and cameras).

        `section` is the prefix of the camera's parameters, such as "ext.lsstcam". The part of the aperture that does
        not collect light (aperture minus collecting area) is assumed to be a central circle.

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
    """Transfer function of the optics with aberrations, divided by that of the same optics without aberrations.

    Attributes
    ----------
    values : complex array, shape (2 m + 1, 2 m + 1)
        The ratio, indexed [y, x], on a square lattice of shifts in the pupil (wavelength times spatial frequency). The
        middle element is shift 0, where the ratio is 1.
    step : float
        Spacing of the lattice of shifts, m.
    """

    values: Complex
    step: float

    @classmethod
    def from_wavefront(cls, nm: Float, telescope: Telescope, wave: float, fried: float, axes: Float) -> TransferRatio:
        """Compute the ratio for a wavefront, without the shift of the image's centroid that the wavefront causes.

        Parameters
        ----------
        nm : float array, shape (z,)
            Zernike coefficients of the wavefront, nm rms; the index is the Noll number.
        telescope : Telescope
            The telescope.
        wave : float
            Wavelength, Angstrom.
        fried : float
            Fried length at this wavelength, m. The lattice of shifts extends to at least 3.3 Fried lengths.
        axes : float array, shape (2, 2)
            Directions of the columns and rows of the detector in the focal plane, see `Detector.axes`.

        Returns
        -------
        TransferRatio
            The ratio in the axes of the detector.
        """
        step = 2.0 * telescope.radius / _ACROSS
        stride = max(int(np.ceil(FARTHEST * fried / (_LATTICE * step))), 1)
        lags = stride * (np.arange(2 * _LATTICE + 3) - _LATTICE - 1)
        x, y, clear, plain = _pupil(telescope.radius, telescope.inner)
        x, y = axes[0, 0] * x + axes[0, 1] * y, axes[1, 0] * x + axes[1, 1] * y
        phase = zernikes.sum_of_zernikes(nm * (20.0 * np.pi / wave), x, y)
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
    """Return a sampled annular pupil: positions x and y, transmission (0 to 1), and its autocorrelation.

    `radius` and `inner` are the outer and inner radius in m. The first three arrays have the shape [n, n]; x and y are
    measured from the centre of the pupil in units of `radius`. The autocorrelation is a square array indexed by the
    shift in samples, in the order of the FFT.
    """
    step = 2.0 / _ACROSS
    axis = (np.arange(_ACROSS + 4) - (_ACROSS + 3) / 2) * step
    x, y = np.meshgrid(axis, axis)
    r = np.hypot(x, y)
    clear = np.clip(0.5 + (1.0 - r) / step, 0.0, 1.0) * np.clip(0.5 + (r - inner / radius) / step, 0.0, 1.0)
    overlap = scipy.fft.irfft2(np.abs(scipy.fft.rfft2(clear, (_TRANSFORM, _TRANSFORM))) ** 2)
    return x, y, clear, np.asarray(overlap)


def ideal_transfer(distance: Float, radius: float, inner: float) -> Float:
    """Return the transfer function of perfect optics with an annular pupil.

    It is the overlap of the pupil with a shifted copy of itself, divided by the area of the pupil.

    Parameters
    ----------
    distance : float array
        Shift in the pupil (wavelength times spatial frequency), m, at least 0.
    radius, inner : float
        Outer and inner radius of the pupil, m.

    Returns
    -------
    float array
        Transfer function in the shape of `distance`: 1 at 0, and 0 for shifts of more than the diameter.
    """
    area = np.pi * (radius**2 - inner**2)
    overlap = (
        _circle_overlap(distance, radius, radius)
        - 2.0 * _circle_overlap(distance, radius, inner)
        + _circle_overlap(distance, inner, inner)
    )
    return np.asarray(overlap / area)


def _circle_overlap(distance: Float, first_radius: float, second_radius: float) -> Float:
    """Return the common area of two circles with given radii, whose centres are `distance` apart (array, any unit)."""
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
