"""Diffraction spikes and rings of a pupil, far from a star.

The light of a point source is spread over angles theta as |A(theta)|^2 / (lambda^2 S), where A is the integral of
exp(-2 pi i x theta / lambda) over the clear pupil and S is the area of the pupil. Far out only edges matter. The
interference of different parts of the pupil varies so fast that their light adds up.

Circles: for an aperture of radius R, A = 2 pi R^2 J1(z) / z with z = 2 pi R theta / lambda. Far out,
J1(z)^2 = 2 / (pi z) cos^2(z - 3 pi / 4), with the mean 1 / (pi z) over rings, so that::

    |A|^2 / (lambda^2 S) = R lambda / (2 pi^2 S theta^3) = P lambda / (4 pi^3 S theta^3)

with the perimeter P = 2 pi R; the perimeters of all circles add up. A pixel of side p at r pixels receives p^2 times
this, with theta = p r: P lambda / (4 pi^3 S p r^3). The value at r = 1 is `ring_light`.

Bars: a straight bar of width w and length l removes A = w l sinc(w u / lambda) sinc(l v / lambda), where u runs across
the bar, v along it, and sinc(x) = sin(pi x) / (pi x). Its light in a pixel is::

    (w l p / lambda)^2 / S  sinc^2(w p r / lambda)  sinc^2(l p t / lambda)

This is a pair of spikes across the bar, with fringes along them; r is the distance along the spike and t that from its
axis, in pixels. Longer bars have narrower spikes. The mean of the fringes is l^2 / (2 pi^2 S r^2) for any width: far
out, spikes are brighter than rings. Each sub-band is the sum of several wavelengths, smoothed across the spike by
jitter, diffusion and the pixel.

References
----------
Born & Wolf, Principles of Optics, sections 8.5.1 (a straight bar) and 8.5.2 (a circle).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Float
from lake_schema.mission.configuration import MissionConfiguration
from truesky.fluxes.passbands import Passband
from truesky.numerics import matrices

# Number of wavelengths per sub-band. The fringes of a bar differ between wavelengths.
_WAVES = 8
# Half the width of a spike, and the steps of its table across and along, pixels. Kernels contain these constants, and
# naming truesky.numerics.compiling here makes this file part of the key of the machine code.
WIDE, STEP, LONG = 40, 0.25, 8.0
# Number of points along a bar for measuring its visible length.
_POINTS = 7001
ARCSEC = np.pi / 180.0 / 3600.0
# Largest distance from a star at which spikes are drawn, arcsec. At this distance, the spikes of a star of 7.4 mag have
# a tenth of the pixel noise of a nominal exposure, and the spikes of a star of 4.9 mag are equal to it.
FARTHEST = 1200.0


@dataclass(frozen=True, slots=True)
class Edges:
    """Edges of a pupil, and other sources of light far from a star.

    Attributes
    ----------
    wavelength : float array, shape (w, n)
        Wavelengths in each sub-band of the PSF, Angstrom.
    area : float
        Clear area, mm^2.
    perimeter : float
        Sum of the perimeters of all circles, mm.
    bars : float array, shape (b, 3)
        Angle (radian), width and visible length (mm) of each bar.
    blur : float
        Rms of jitter and diffusion, arcsec.
    pixel_scale : float
        Arcsec per pixel.
    period : float
        Period of the plane's transform, pixels; 0 if its aliasing is negligible.
    halo : (float, float)
        Values (A, c) of the aureole, A / (r^2 + c^2) of the light per arcsec^2 at r arcsec.
    """

    wavelength: Float
    area: float
    perimeter: float
    bars: Float
    blur: float
    pixel_scale: float
    period: float
    halo: tuple[float, float] = (0.0, 1.0)

    @property
    def aureole(self) -> tuple[float, float]:
        """Values (A, c^2) of the aureole per pixel, with distances in pixels."""
        return self.halo[0], (self.halo[1] / self.pixel_scale) ** 2


def wavelengths(parts: tuple[Passband, ...]) -> Float:
    """Wavelengths of sub-bands [w, n], Angstrom: the middles of parts with equal numbers of photons."""
    places = (np.arange(_WAVES) + 0.5) / _WAVES
    waves = []
    for part in parts:
        photons = np.cumsum(part.response / part.wavelength)
        waves.append(part.wavelength[np.searchsorted(photons, places * photons[-1])])
    return np.array(waves)


def from_euclid_pupil(
    parts: tuple[Passband, ...], blur: float, pixel_scale: float, period: float, mission: MissionConfiguration
) -> Edges:
    """Edges of the Euclid pupil: aperture stop, central stop, and three bars where they are not hidden by the stops.

    Parameters
    ----------
    parts : tuple of Passband
        Sub-bands of the PSF.
    blur : float
        Rms of jitter and diffusion, arcsec.
    pixel_scale : float
        Arcsec per pixel.
    period : float
        Period of the plane's transform, pixels.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    Edges
        The edges.
    """
    radius = 0.5 * mission.value("plm.aperture_diameter", "mm")
    stop, stop_y = mission.value("plm.pupil.stop_radius", "mm"), mission.value("plm.pupil.stop_y", "mm")
    width, reach = (mission.value(f"plm.pupil.spider_{key}", "mm") for key in ("width", "half_length"))
    bars = []
    for bar in ("spider1", "spider2", "spider3"):
        x, y = mission.value(f"plm.pupil.{bar}.x", "mm"), mission.value(f"plm.pupil.{bar}.y", "mm")
        angle = mission.value(f"plm.pupil.{bar}.angle", "rad")
        along = np.linspace(-reach, reach, _POINTS)
        x, y = x + along * np.cos(angle), y + along * np.sin(angle)
        visible = (np.hypot(x, y) < radius) & (np.hypot(x, y - stop_y) > stop)
        bars.append((angle, width, 2.0 * reach * float(visible.mean())))
    blocked = sum(width * length for _, width, length in bars)
    area = np.pi * (radius**2 - stop**2) - blocked
    circles = 2.0 * np.pi * (radius + stop)
    return Edges(wavelengths(parts), area, circles, np.array(bars), blur, pixel_scale, period)


def ring_light(edges: Edges, photons: Float) -> float:
    """Fraction of a star's light in a pixel at a distance of one pixel, extrapolated by the law r^-3.

    Parameters
    ----------
    edges : Edges
        Edges of the pupil.
    photons : float array, shape (w,)
        Fraction of the photons in each sub-band.

    Returns
    -------
    float
        The fraction. The error is 3 % beyond 5 arcsec, 1 % of which is caused by bars that hide the circles.
    """
    wavelength = float(matrices.matmul(photons, edges.wavelength.mean(axis=1))) * 1e-7
    return wavelength * edges.perimeter / (4.0 * np.pi**3 * edges.area) / (edges.pixel_scale * ARCSEC)


def spike_light(edges: Edges, photons: Float, reach: float) -> Float:
    """Fraction of a star's light in the pixels of each bar's spike.

    Parameters
    ----------
    edges : Edges
        Edges of the pupil.
    photons : float array, shape (w,)
        Fraction of the photons in each sub-band.
    reach : float
        Length of the spike, pixels.

    Returns
    -------
    float array, shape (b, r, t)
        The fraction at r LONG pixels along the spike and t STEP pixels from its axis.
    """
    share = np.repeat(photons / _WAVES, _WAVES)
    cycles = edges.pixel_scale * ARCSEC / (edges.wavelength.ravel() * 1e-7)
    out = LONG * np.arange(int(reach / LONG) + 2)
    # The table is wider than the result, to include the light that the blur moves into it.
    across = STEP * np.arange(2 * round(WIDE / STEP))
    lines = []
    for _, width, length in edges.bars:
        height = share * (width * length * cycles) ** 2 / edges.area
        along = np.sinc(width * cycles * out[:, None]) ** 2 * height
        lines.append(
            _blur_lines(np.sinc(length * cycles[:, None] * across) ** 2, edges.blur / edges.pixel_scale, along)
        )
    return np.stack(lines)


def reach(edges: Edges, electrons: Float, min_electrons: float) -> Float:
    """Distance from a star up to which its spikes or its aureole are noticeable.

    Parameters
    ----------
    edges : Edges
        Edges of the pupil.
    electrons : float array, shape (n,)
        Expected electrons of the stars.
    min_electrons : float
        Smallest noticeable light in a pixel, electrons.

    Returns
    -------
    float array, shape (n,)
        Distance of the last such pixel, pixels, at most FARTHEST arcsec.

    Notes
    -----
    The error is 15 %, because of fringes along the spike and because sub-bands are treated as equal.
    """
    share = 1.0 / edges.wavelength.size
    cycles = edges.pixel_scale * ARCSEC / (edges.wavelength.ravel() * 1e-7)
    across, blur = STEP * np.arange(2 * round(WIDE / STEP)), edges.blur / edges.pixel_scale
    # Light that the blur moves from each position, on both sides, to the middle.
    blur_kernel = np.fft.irfft(_blur_transfer(2 * len(across) - 1, blur), 2 * len(across) - 1)[: len(across)]
    blur_kernel[1:] *= 2.0
    # The mean of the fringes is half of their peak.
    middle = [
        share
        * float(np.maximum((np.sinc(length * cycles[:, None] * across) ** 2 * blur_kernel).sum(axis=1), 0.0).sum())
        * (length / np.pi) ** 2
        / (2.0 * edges.area)
        for _, _, length in edges.bars
    ]
    farthest = FARTHEST / edges.pixel_scale
    return np.asarray(
        np.minimum(np.sqrt(max(*middle, edges.halo[0]) * electrons / max(min_electrons, 1e-300)), farthest)
    )


def _blur_lines(lines: Float, blur: float, along: Float) -> Float:
    """Sum of the lines [w, t], t >= 0, blurred by jitter, diffusion and pixel: [r, t] up to WIDE."""
    symmetric = np.concatenate([lines[:, :0:-1], lines], axis=1)
    passed = np.fft.rfft(symmetric, axis=1) * _blur_transfer(symmetric.shape[1], blur)
    smooth = np.fft.irfft(passed, symmetric.shape[1], axis=1)[:, lines.shape[1] - 1 :]
    return np.asarray(matrices.matmul(along, np.maximum(smooth[:, : round(WIDE / STEP) + 2], 0.0)))


def _blur_transfer(count: int, blur: float) -> Float:
    """Transfer function of jitter, diffusion and pixel at the frequencies of `count` samples."""
    k = 2.0 * np.pi * np.fft.rfftfreq(count, STEP)
    return np.asarray(np.exp(-0.5 * (blur * k) ** 2) * np.sinc(k / (2.0 * np.pi)))
