"""Compute the wings of Euclid's PSF from its pupil: the table truesky/validation/lake/measure/pupil_wings.csv.

    python -m scripts.pupil_wings > truesky/validation/lake/measure/pupil_wings.csv

Each number is the fraction of a star's light per arcsec^2 at a radius, averaged over position angles, over a ring of
radii, and over the photons of a band for constant f_nu. Aberrations, jitter and charge diffusion are not included: they
change the light beyond 1" by a few per cent.

The Fourier transform A of the clear pupil is a sum of closed forms: the transform of the aperture stop, minus the
transforms of the decentred central stop and of the visible parts of three spider bars. The fraction
|A|^2 / (lambda^2 S) of the light arrives per steradian; S is the clear area. Near the star, the sum includes the
interference of all parts. Farther out, the light of rings and spikes simply adds up on average::

    rings    lambda P / (4 pi^3 S theta^3)                              P: perimeter of both circles
    spikes   w^2 l / (pi lambda S theta) sinc^2(w theta / lambda)       of each bar, width w, visible length l

References
----------
Born & Wolf, Principles of Optics, sections 8.5.1, 8.5.2 and 8.8 (bar, circle, edges); Liaudat et al. 2023 (pupil)
"""

from __future__ import annotations

import sys

import numpy as np
from scipy.special import j1

from lake_schema.arrays import Array, Float
from lake_schema.mission.configuration import MissionConfiguration, resolve
from truesky.fluxes import passbands

BANDS = ("euclid_vis", "euclid_y", "euclid_j", "euclid_h")
# Radii of the table, arcsec: the first, the last, and their ratio. Rings extend half-way to the neighbours.
_FIRST, _LAST, _RATIO = 0.4, 240.0, 1.12
# Up to this radius, in units of wavelength / diameter, the interference of all parts of the pupil is computed.
_NEAR = 25.0
# Numbers of wavelengths of a band, of radii within a ring, and of position angles in half a turn.
_WAVES, _RADII, _ANGLES = 39, 4, 360
# Points along a bar at which it is tested whether it lies in the clear pupil.
_POINTS = 20001
# Radian per arcsec.
_ARCSEC = np.pi / 180.0 / 3600.0


class Pupil:
    """The clear pupil of Euclid in mm: two circles and the visible parts of three bars."""

    def __init__(self, mission: MissionConfiguration) -> None:
        self.radius = 0.5 * mission.value("plm.aperture_diameter", "mm")
        self.stop, self.stop_y = (mission.value(f"plm.pupil.stop_{key}", "mm") for key in ("radius", "y"))
        self.width = mission.value("plm.pupil.spider_width", "mm")
        along = np.linspace(-1.0, 1.0, _POINTS) * mission.value("plm.pupil.spider_half_length", "mm")
        self.bars = []
        for bar in ("spider1", "spider2", "spider3"):
            x, y = (mission.value(f"plm.pupil.{bar}.{axis}", "mm") for axis in "xy")
            angle = mission.value(f"plm.pupil.{bar}.angle", "rad")
            x, y = x + along * np.cos(angle), y + along * np.sin(angle)
            visible = np.flatnonzero((np.hypot(x, y) < self.radius) & (np.hypot(x, y - self.stop_y) > self.stop))
            middle = (visible[0] + visible[-1]) // 2
            self.bars.append((angle, float(along[visible[-1]] - along[visible[0]]), float(x[middle]), float(y[middle])))
        blocked = sum(self.width * length for _, length, _, _ in self.bars)
        self.area = np.pi * (self.radius**2 - self.stop**2) - blocked

    def light_near(self, theta: float, wavelength: float) -> float:
        """Return the mean fraction of the light per steradian at theta (radian) for a wavelength (mm)."""
        turn, q = (np.arange(_ANGLES) + 0.5) * np.pi / _ANGLES, 2.0 * np.pi * theta / wavelength
        qx, qy = q * np.cos(turn), q * np.sin(turn)
        total: Array = _circle(self.radius, q) - _circle(self.stop, q) * np.exp(-1j * qy * self.stop_y)
        for angle, length, x, y in self.bars:
            across, along = qy * np.cos(angle) - qx * np.sin(angle), qx * np.cos(angle) + qy * np.sin(angle)
            bar = np.sinc(0.5 * self.width * across / np.pi) * np.sinc(0.5 * length * along / np.pi)
            total = total - self.width * length * bar * np.exp(-1j * (qx * x + qy * y))
        return float(np.mean(np.abs(total) ** 2)) / (wavelength**2 * self.area)

    def light_far(self, theta: float, wavelength: float) -> float:
        """Return the same without interference of the parts of the pupil."""
        perimeter = 2.0 * np.pi * (self.radius + self.stop)
        rings = wavelength * perimeter / (4.0 * np.pi**3 * self.area * theta**3)
        spikes = sum(self.width**2 * length for _, length, _, _ in self.bars) / (np.pi * wavelength * self.area * theta)
        return float(rings + spikes * np.sinc(self.width * theta / wavelength) ** 2)


def _circle(radius: float, q: float) -> float:
    return float(2.0 * np.pi * radius**2 * j1(q * radius) / (q * radius))


def band_wavelengths(name: str) -> Float:
    """Return wavelengths with equal numbers of photons of a passband, for constant f_nu, mm."""
    band = passbands.load(name)
    photons = np.cumsum(band.response / band.wavelength)
    places = (np.arange(_WAVES) + 0.5) / _WAVES * photons[-1]
    return np.asarray(1e-7 * band.wavelength[np.searchsorted(photons, places)], float)


def profile(pupil: Pupil, waves: Float, radius: float) -> float:
    """Return the mean fraction of the light per arcsec^2 in the ring about a radius in arcsec."""
    edges = radius * _RATIO**-0.5, radius * _RATIO**0.5
    # The radii divide the ring into parts of the same area.
    squares = edges[0] ** 2 + (np.arange(_RADII) + 0.5) / _RADII * (edges[1] ** 2 - edges[0] ** 2)
    values = []
    for wavelength in waves.tolist():
        limit = _NEAR * wavelength / (2.0 * pupil.radius)
        for theta in (np.sqrt(squares) * _ARCSEC).tolist():
            values.append(pupil.light_near(theta, wavelength) if theta < limit else pupil.light_far(theta, wavelength))
    return float(np.mean(values)) * _ARCSEC**2


def table() -> str:
    """Return the text of the table."""
    pupil = Pupil(resolve())
    radii = _FIRST * _RATIO ** np.arange(int(np.log(_LAST / _FIRST) / np.log(_RATIO)) + 2)
    waves = {band: band_wavelengths(band) for band in BANDS}
    lines = [",".join(("radius", *BANDS))]
    for radius in radii.tolist():
        values = (profile(pupil, waves[band], radius) for band in BANDS)
        lines.append(",".join((f"{radius:.4f}", *(f"{value:.4e}" for value in values))))
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.stdout.write(table())
