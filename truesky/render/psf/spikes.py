"""Diffraction spikes and rings of a pupil, far from a star.

Edges     of a pupil;  of_pupil : the Euclid one's
ring, spikes   light in a pixel;  wavelengths : that they are made of;  reach : how far out a star's spikes are noticed

A point's light is spread over angles theta as |A(theta)|^2 / (lambda^2 S), where A is the integral of
exp(-2 pi i x theta / lambda) over the clear pupil and S the pupil's area.  Far out only edges count, and those of
different parts of the pupil beat so fast that their light adds up.

Circles. Of an aperture of radius R, A = 2 pi R^2 J1(z) / z with z = 2 pi R theta / lambda.  Far out
J1(z)^2 = 2 / (pi z) cos^2(z - 3 pi / 4), whose mean over rings is 1 / (pi z), so that

    |A|^2 / (lambda^2 S) = R lambda / (2 pi^2 S theta^3) = P lambda / (4 pi^3 S theta^3)

with the perimeter P = 2 pi R: perimeters of all circles add up.  A pixel of side p at r pixels has p^2 of that, with
theta = p r: P lambda / (4 pi^3 S p r^3), which is `ring` at r = 1.

Bars. A straight bar of width w and length l takes A = w l sinc(w u / lambda) sinc(l v / lambda) away, where u runs
across the bar and v along it, sinc(x) = sin(pi x) / (pi x).  Its light in a pixel,

    (w l p / lambda)^2 / S  sinc^2(w p r / lambda)  sinc^2(l p t / lambda),

is a pair of spikes across the bar (r pixels out) as narrow as l is long (t pixels beside their middle), with fringes
along them.  The mean of the fringes is l^2 / (2 pi^2 S r^2), whatever the width: far out spikes outshine rings.
Each sub-band is the sum of its wavelengths, smoothed across by jitter, diffusion and the pixel.

Ref : Born & Wolf, Principles of Optics, sections 8.5.1 (a straight bar) and 8.5.2 (a circle)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Float
from lake_schema.mission.configuration import MissionConfiguration
from truesky.fluxes.passbands import Passband
from truesky.numerics import matrices

# Wavelengths in each sub-band: a bar's fringes run through each other.
_WAVES = 8
# Half the width of a spike, pixels, and the steps of its table across and along. Kernels contain these constants, and
# naming truesky.numerics.compiling here makes this file part of the key of the machine code.
WIDE, STEP, LONG = 40, 0.25, 8.0
# Points along a bar that tell how much of it is seen.
_POINTS = 7001
ARCSEC = np.pi / 180.0 / 3600.0
# Spikes are followed so far from a star, arcsec. There one of 7.4 mag still draws lines of a tenth of a pixel's noise
# over a nominal exposure, one of 4.9 mag of as much as it.
FARTHEST = 1200.0


@dataclass(frozen=True, slots=True)
class Edges:
    """What of a pupil counts far from a star.

    wavelength : float64[w, n] A, by sub-band of the PSF
    area       : mm2, clear;  round : mm, of all circles' perimeters
    bars       : float64[b, 3] angle (radian), width and visible length (mm)
    blur       : arcsec rms, of jitter and diffusion;  pixel_scale : arcsec
    period     : pixels after which the plane's transform repeats itself; 0: what it folds is not noticed
    halo       : aureole, A / (r^2 + c^2) of the light in an arcsec2 at r arcsec: (A, c)
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
        """The same in a pixel at r pixels: (A, c^2)."""
        return self.halo[0], (self.halo[1] / self.pixel_scale) ** 2


def wavelengths(parts: tuple[Passband, ...]) -> Float:
    """Edges.wavelength of sub-bands: the middles of parts of as many photons."""
    places = (np.arange(_WAVES) + 0.5) / _WAVES
    waves = []
    for part in parts:
        photons = np.cumsum(part.response / part.wavelength)
        waves.append(part.wavelength[np.searchsorted(photons, places * photons[-1])])
    return np.array(waves)


def from_euclid_pupil(
    parts: tuple[Passband, ...], blur: float, pixel_scale: float, period: float, mission: MissionConfiguration
) -> Edges:
    """Of the Euclid pupil: the aperture stop, the central stop and three bars, as far as the stops let them be seen.

    parts : sub-bands of the PSF;  blur, pixel_scale, period : of Edges
    mission : the mission database
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
    """Of a star's light in a pixel at a distance of one pixel, were the law r^-3 good there.

    photons : [w] share of each sub-band
    Error   : 3 % beyond 5", 1 % of it where the bars hide the circles
    """
    wavelength = float(matrices.matmul(photons, edges.wavelength.mean(axis=1))) * 1e-7
    return wavelength * edges.perimeter / (4.0 * np.pi**3 * edges.area) / (edges.pixel_scale * ARCSEC)


def spike_light(edges: Edges, photons: Float, reach: float) -> Float:
    """float64[b, r, t] of a star's light in a pixel on each bar's spike: r times 8 pixels out, t times 1/4 across.

    reach : pixels
    """
    share = np.repeat(photons / _WAVES, _WAVES)
    cycles = edges.pixel_scale * ARCSEC / (edges.wavelength.ravel() * 1e-7)
    out = LONG * np.arange(int(reach / LONG) + 2)
    # Wider than it is kept: what the blur brings in.
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
    """float64[n] pixels as far as which a star's brightest spike, or its aureole, has a pixel of `least` electrons.

    At most FARTHEST.

    Error : 15 %, of fringes along the spike, and of colours: sub-bands are taken as equal
    """
    share = 1.0 / edges.wavelength.size
    cycles = edges.pixel_scale * ARCSEC / (edges.wavelength.ravel() * 1e-7)
    across, blur = STEP * np.arange(2 * round(WIDE / STEP)), edges.blur / edges.pixel_scale
    # What the blur takes of each place into the middle, of both sides.
    blur_kernel = np.fft.irfft(_blur_transfer(2 * len(across) - 1, blur), 2 * len(across) - 1)[: len(across)]
    blur_kernel[1:] *= 2.0
    # Of fringes whose mean is half of r^-2.
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
    """Sum of the lines [w, t], t >= 0, through jitter, diffusion and pixel: [r, t] up to _WIDE."""
    symmetric = np.concatenate([lines[:, :0:-1], lines], axis=1)
    passed = np.fft.rfft(symmetric, axis=1) * _blur_transfer(symmetric.shape[1], blur)
    smooth = np.fft.irfft(passed, symmetric.shape[1], axis=1)[:, lines.shape[1] - 1 :]
    return np.asarray(matrices.matmul(along, np.maximum(smooth[:, : round(WIDE / STEP) + 2], 0.0)))


def _blur_transfer(count: int, blur: float) -> Float:
    """Of each frequency of so many samples, what jitter, diffusion and pixel leave."""
    k = 2.0 * np.pi * np.fft.rfftfreq(count, STEP)
    return np.asarray(np.exp(-0.5 * (blur * k) ** 2) * np.sinc(k / (2.0 * np.pi)))
