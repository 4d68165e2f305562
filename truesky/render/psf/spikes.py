"""Diffraction spikes and rings around a star, far from its core, computed from the edges of the telescope's pupil.

At an angle theta from a point source, the fraction |A(theta)|^2 / (lambda^2 S) of its light arrives per steradian. Here
lambda is the wavelength, S the area of the clear pupil, and A the integral of exp(-2 pi i x theta / lambda) over the
positions x in the clear pupil. Far from the source only the edges of the pupil matter. The interference between
different edges varies so fast with theta that, on average, their light simply adds up.

Circles: for an aperture of radius R, A = 2 pi R^2 J1(z) / z with z = 2 pi R theta / lambda. Far out,
J1(z)^2 = 2 / (pi z) cos^2(z - 3 pi / 4), with the mean 1 / (pi z) over rings, so that::

    |A|^2 / (lambda^2 S) = R lambda / (2 pi^2 S theta^3) = P lambda / (4 pi^3 S theta^3)

with the perimeter P = 2 pi R; the perimeters of all circles add up. A pixel of side p (radian) at a distance of r
pixels receives p^2 times this, with theta = p r: P lambda / (4 pi^3 S p r^3). The function `ring_light` returns this
fraction for r = 1.

Bars: a straight bar of width w and length l blocks the part A = w l sinc(w u / lambda) sinc(l v / lambda) of the
integral. Here u and v are the components of theta across and along the bar, and sinc(x) = sin(pi x) / (pi x). Far from
the source, a blocked part gives as much light as an opening of the same shape (Babinet's principle). The fraction of
the light in a pixel is::

    (w l p / lambda)^2 / S  sinc^2(w p r / lambda)  sinc^2(l p t / lambda)

This formula describes a pair of spikes perpendicular to the bar, with fringes along them. r is the distance along the
spike and t the distance from its axis, in pixels. Longer bars have narrower spikes. On the axis, the mean over the
fringes is l^2 / (2 pi^2 S r^2) for any width w: far out, spikes are brighter than rings. The light of a sub-band of the
passband is the sum over several wavelengths, smoothed across the spike by pointing jitter, charge diffusion and the
pixel.

References
----------
Born & Wolf, Principles of Optics, sections 8.5.1 (a straight bar) and 8.5.2 (a circle).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from lake_schema.arrays import Float
from lake_schema.mission.configuration import MissionConfiguration
from truesky.fluxes.passbands import Passband
from truesky.numerics import matrices

# Number of wavelengths per sub-band of the passband at which spikes are computed and added. Several are needed, since
# the fringes along a spike lie at distances proportional to the wavelength.
_WAVES = 8
# Largest distance from the axis of a spike, pixels, up to which the light of the spike is tabulated and drawn. Another
# module compiles STEP and LONG into machine code, which is cached. The key of this cache includes every file with the
# text truesky.numerics.compiling, as in this comment, so that the code is compiled again if these values change.
WIDE = 40
# Spacing, across the spike, of the points at which the light of a spike is tabulated, pixels.
STEP = 0.25
# Spacing, along the spike, of the points at which the light of a spike is tabulated, pixels.
LONG = 8.0
# Number of points along a spider bar at which it is tested whether the bar lies in the clear pupil. The fraction of
# visible points gives the visible length of the bar.
_POINTS = 7001
# Radian per arcsec.
ARCSEC = np.pi / 180.0 / 3600.0
# Largest distance between a star and a detector on which its spikes are drawn, arcsec. On this detector, the spikes of
# a star at rest are drawn up to the farthest corner, but those of a moving star only up to this distance from it. At
# this distance, spikes of a star of 7.4 mag have a tenth of the pixel noise of a nominal exposure, and spikes of a star
# of 4.9 mag equal the pixel noise.
FARTHEST = 1200.0
# Tables along spikes are computed for a multiple of this number of distances, so that stars share them.
_COUNT_STEP = 512


@dataclass(frozen=True, slots=True)
class Edges:
    """Everything that causes light far from a star: edges of the telescope's pupil, and an aureole.

    Attributes
    ----------
    wavelength : float array, shape (w, n)
        n wavelengths in each of w sub-bands of the passband, Angstrom.
    area : float
        Area of the pupil through which light passes, mm^2.
    perimeter : float
        Sum of the perimeters of all circular edges of the pupil, mm. It determines the brightness of diffraction rings.
    bars : float array, shape (b, 3)
        For each straight bar of the spider: angle of its axis from x towards y (radian), width and visible length (mm).
        It causes a pair of spikes perpendicular to it.
    blur : float
        Rms of the blur by pointing jitter and charge diffusion (or by the air), arcsec, which widens the spikes.
    pixel_scale : float
        Arcsec per pixel.
    period : float
        Period of the discrete Fourier transform with which the PSF images were computed, pixels. Because of it, the
        images contain aliased light from beyond their borders. 0 if this light is negligible.
    halo : (float, float)
        Values (A, c) of the aureole: at r arcsec, the fraction A / (r^2 + c^2) of the star's light per arcsec^2, with c
        in arcsec. (0, 1) for no aureole.
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
        """Values (A, c^2) of the aureole in pixels instead of arcsec.

        A pixel at a distance of r pixels has the fraction A / (r^2 + c^2) of the star's light.
        """
        return self.halo[0], (self.halo[1] / self.pixel_scale) ** 2


def wavelengths(parts: tuple[Passband, ...]) -> Float:
    """Return n = 8 representative wavelengths of each of the w sub-bands `parts` of a passband, Angstrom: [w, n].

    A sub-band is divided into n intervals with equal numbers of photons for constant f_nu. The result contains the
    wavelength in the middle of the photons of each interval.
    """
    places = (np.arange(_WAVES) + 0.5) / _WAVES
    waves = []
    for part in parts:
        photons = np.cumsum(part.response / part.wavelength)
        waves.append(part.wavelength[np.searchsorted(photons, places * photons[-1])])
    return np.array(waves)


def from_euclid_pupil(
    parts: tuple[Passband, ...], blur: float, pixel_scale: float, period: float, mission: MissionConfiguration
) -> Edges:
    """Return the edges of Euclid's pupil: aperture stop, central stop, and the visible parts of three spider bars.

    Parameters
    ----------
    parts : tuple of Passband
        Sub-bands of the passband.
    blur : float
        Rms of the blur by pointing jitter and charge diffusion, arcsec.
    pixel_scale : float
        Arcsec per pixel.
    period : float
        Period of the discrete Fourier transform with which the PSF images are computed, pixels. Because of it, the
        images contain aliased light from beyond their borders.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras).

    Returns
    -------
    Edges
        Edges of the pupil, without an aureole.
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
    """Return the brightness of a star's diffraction rings, averaged over the rings.

    Parameters
    ----------
    edges : Edges
        Edges of the pupil.
    photons : float array, shape (w,)
        Fraction of the star's photons in each sub-band of the passband.

    Returns
    -------
    float
        Fraction of the star's light in a pixel one pixel away, extrapolated with the law r^-3 from large distances.
        Divide it by r^3 to get the fraction in a pixel at a distance of r pixels. Beyond 5 arcsec the error is 3 %, of
        which 1 % is caused by bars that hide parts of the circular edges.
    """
    wavelength = float(matrices.matmul(photons, edges.wavelength.mean(axis=1))) * 1e-7
    return wavelength * edges.perimeter / (4.0 * np.pi**3 * edges.area) / (edges.pixel_scale * ARCSEC)


def spike_light(edges: Edges, photons: Float, reach: float) -> Float:
    """Return tables of the diffraction spikes of a star, one for each of b bars of the pupil.

    Parameters
    ----------
    edges : Edges
        Edges of the pupil.
    photons : float array, shape (w,)
        Fraction of the star's photons in each sub-band of the passband.
    reach : float
        Length of the spikes from the star, pixels.

    Returns
    -------
    float array, shape (b, r, t)
        Fraction of the star's light in a pixel, at 0, LONG, 2 LONG ... pixels along the spike and 0, STEP, 2 STEP ...
        pixels from its axis.
    """
    share = np.repeat(photons / _WAVES, _WAVES)
    cycles = edges.pixel_scale * ARCSEC / (edges.wavelength.ravel() * 1e-7)
    count, lines = int(reach / LONG) + 2, []
    for _, width, length in edges.bars:
        height = share * (width * length * cycles) ** 2 / edges.area
        fringes = _fringes(cycles.tobytes(), float(width), -(-count // _COUNT_STEP) * _COUNT_STEP)
        along = fringes[:count] * height
        across = _blurred_profiles(cycles.tobytes(), float(length), edges.blur / edges.pixel_scale)
        lines.append(matrices.matmul(along, across))
    return np.stack(lines)


def max_reach(edges: Edges, photons: Float, faintest: float) -> float:
    """Return a distance from a star in pixels beyond which its spikes are certainly fainter than a limit.

    Parameters
    ----------
    edges : Edges
        Edges of the pupil.
    photons : float array, shape (w,)
        Fraction of the star's photons in each sub-band of the passband.
    faintest : float
        Fraction of the star's light in a pixel, more than 0.

    Returns
    -------
    float
        Distance beyond which all numbers of `spike_light` are below `faintest`; 0 without bars.

    Notes
    -----
    At the distance r along a spike, sinc(x) with x = width * cycles * r is at most 1 / (pi x).
    """
    share = np.repeat(photons / _WAVES, _WAVES)
    cycles = edges.pixel_scale * ARCSEC / (edges.wavelength.ravel() * 1e-7)
    factors = [
        share
        * (length * length / (np.pi**2 * edges.area))
        * _blurred_profiles(cycles.tobytes(), float(length), edges.blur / edges.pixel_scale).max(axis=1)
        for _, _, length in edges.bars
    ]
    return float(np.sqrt(max((factor.sum() for factor in factors), default=0.0) / faintest))


def reach(edges: Edges, electrons: Float, min_electrons: float) -> Float:
    """Return the distance from each of n stars up to which its diffraction spikes or its aureole are noticeable.

    Parameters
    ----------
    edges : Edges
        Edges of the pupil.
    electrons : float array, shape (n,)
        Expected electrons of the stars.
    min_electrons : float
        Electrons in a pixel below which the light of spikes and aureole is not noticeable.

    Returns
    -------
    float array, shape (n,)
        Distance in pixels at which the light falls below `min_electrons`, at most FARTHEST (1200 arcsec).

    Notes
    -----
    The error is 15 %, because fringes along the spike are averaged, and because equal numbers of photons are assumed
    in all sub-bands.
    """
    share = 1.0 / edges.wavelength.size
    cycles = edges.pixel_scale * ARCSEC / (edges.wavelength.ravel() * 1e-7)
    across, blur = STEP * np.arange(2 * round(WIDE / STEP)), edges.blur / edges.pixel_scale
    # Weights with which the blur moves light to the axis of a spike, for each distance from the axis. Both sides are
    # added, so that all weights except that of the axis itself are doubled.
    blur_kernel = np.fft.irfft(_blur_transfer(2 * len(across) - 1, blur), 2 * len(across) - 1)[: len(across)]
    blur_kernel[1:] *= 2.0
    # Fraction of the star's light in a pixel on the axis of each bar's spike, times the square of the distance in
    # pixels. Along a spike, fringes vary as sin^2, whose mean is half of the maximum.
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


@lru_cache(maxsize=32)
def _fringes(cycles: bytes, width: float, count: int) -> Float:
    """Return the light [count, w] along the spike of a bar at w wavelengths, relative to that at the star.

    Rows are LONG pixels apart. `cycles` [w] are the float64 numbers of pixel scales per wavelength in 1/mm, as bytes,
    and `width` is the width of the bar in mm. Bright stars of an exposure share the result.
    """
    fringes: Float = np.sinc(width * np.frombuffer(cycles) * (LONG * np.arange(count))[:, None]) ** 2
    fringes.flags.writeable = False
    return fringes


@lru_cache(maxsize=32)
def _blurred_profiles(cycles: bytes, length: float, blur: float) -> Float:
    """Return profiles [w, j] across the spike of a bar at w wavelengths, blurred by a Gaussian and by the pixel.

    All bright stars of an exposure have the same profiles. j counts steps of STEP pixels from the axis of the spike, up
    to WIDE pixels. Before the blur, the light on the axis is 1. `cycles` [w] are the float64 numbers of pixel scales
    per wavelength in 1/mm, as bytes. `length` is the length of the bar in mm, and `blur` the rms of the Gaussian in
    pixels.
    """
    # Profiles without blur are computed up to twice the distance from the axis that the result has, since the blur
    # moves light from outside into it.
    across = STEP * np.arange(2 * round(WIDE / STEP))
    lines = np.sinc(length * np.frombuffer(cycles)[:, None] * across) ** 2
    symmetric = np.concatenate([lines[:, :0:-1], lines], axis=1)
    passed = np.fft.rfft(symmetric, axis=1) * _blur_transfer(symmetric.shape[1], blur)
    smooth = np.fft.irfft(passed, symmetric.shape[1], axis=1)[:, lines.shape[1] - 1 :]
    profiles: Float = np.maximum(smooth[:, : round(WIDE / STEP) + 2], 0.0)
    profiles.flags.writeable = False
    return profiles


def _blur_transfer(count: int, blur: float) -> Float:
    """Return the transfer function of a Gaussian blur (rms `blur` pixels) and of the pixel.

    It is the product of both along one axis, at the frequencies of a real FFT of `count` samples that are STEP pixels
    apart. The pixel averages over its width.
    """
    k = 2.0 * np.pi * np.fft.rfftfreq(count, STEP)
    return np.asarray(np.exp(-0.5 * (blur * k) ** 2) * np.sinc(k / (2.0 * np.pi)))
