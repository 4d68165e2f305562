"""Light that the pupil's edges diffract far from a bright star, where its PSF's plane has ended.

So far out the rings of a band's wavelengths overlap: what is left of them falls as r^-3. Each straight bar draws two
spikes across itself, as wide as it is long, with the fringes of its width along them.

Edges     of a pupil;  of_pupil : the Euclid one's
add       what a star shines outside the plane, onto a frame
unfold    what of it the plane has inside, taken off
reach     how far out a star's spikes are noticed
left      how the plane fades there

Ref : Born & Wolf, Principles of Optics, sections 8.5.1 (a straight bar) and 8.5.2 (a circle, far out)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from jobs.compiling import jit
from jobs.fluxes.passbands import Passband
from jobs.render.kernel import FIXED_POINT
from lake_schema.mission.configuration import MissionConfiguration

Float = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]

# Wavelengths in each sub-band: a bar's fringes run through each other.
_WAVES = 8
# Half the width of a spike, pixels, and the steps of its table across and along.
_WIDE, _STEP, _LONG = 40, 0.25, 8.0
# Light is drawn to where it is this part of what may be left out: its border is not to be seen.
_FAINTEST = 0.5
# Pixels over which the plane fades, and its outermost, which are not used: a stamp is periodic.
_FADING, _SPARED = 24.0, 2.0
# Of the light at the plane's sides, at most what was folded into its corners; none to speak of so near to its middle,
# of the period.
_FOLDED, _NEAR = 0.2, 0.15
# Points along a bar that tell how much of it is seen.
_POINTS = 7001
_ARCSEC = np.pi / 180.0 / 3600.0
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
    period     : pixels after which the plane's transform repeats itself
    """

    wavelength: Float
    area: float
    round: float
    bars: Float
    blur: float
    pixel_scale: float
    period: float


def of_pupil(
    parts: tuple[Passband, ...], blur: float, pixel_scale: float, period: float, mission: MissionConfiguration
) -> Edges:
    """Of the Euclid pupil: the aperture stop, the central stop and three bars, as far as the stops let them be seen.

    parts : sub-bands of the PSF;  blur, pixel_scale, period : of Edges
    """
    # The middles of parts of as many photons.
    places = (np.arange(_WAVES) + 0.5) / _WAVES
    waves = []
    for part in parts:
        photons = np.cumsum(part.response / part.wavelength)
        waves.append(part.wavelength[np.searchsorted(photons, places * photons[-1])])
    radius = 0.5 * mission.value("plm.aperture_diameter", "mm")
    stop, stop_y = mission.value("plm.pupil.stop_radius", "mm"), mission.value("plm.pupil.stop_y", "mm")
    width, reach = (mission.value(f"plm.pupil.spider_{key}", "mm") for key in ("width", "half_length"))
    bars = []
    for bar in ("spider1", "spider2", "spider3"):
        x, y = mission.value(f"plm.pupil.{bar}.x", "mm"), mission.value(f"plm.pupil.{bar}.y", "mm")
        angle = mission.value(f"plm.pupil.{bar}.angle", "rad")
        along = np.linspace(-reach, reach, _POINTS)
        x, y = x + along * np.cos(angle), y + along * np.sin(angle)
        seen = (np.hypot(x, y) < radius) & (np.hypot(x, y - stop_y) > stop)
        bars.append((angle, width, 2.0 * reach * float(seen.mean())))
    blocked = sum(width * length for _, width, length in bars)
    area = np.pi * (radius**2 - stop**2) - blocked
    circles = 2.0 * np.pi * (radius + stop)
    return Edges(np.array(waves), area, circles, np.array(bars), blur, pixel_scale, period)


def ring(edges: Edges, photons: Float) -> float:
    """Of a star's light in a pixel at a distance of one pixel, were the law r^-3 good there.

    photons : [w] share of each sub-band
    Error   : 3 % beyond 5", 1 % of it where the bars hide the circles
    """
    wavelength = float(photons @ edges.wavelength.mean(axis=1)) * 1e-7
    return wavelength * edges.round / (4.0 * np.pi**3 * edges.area) / (edges.pixel_scale * _ARCSEC)


def spikes(edges: Edges, photons: Float, reach: float) -> Float:
    """float64[b, r, t] of a star's light in a pixel on each bar's spike: r times 8 pixels out, t times 1/4 across.

    reach : pixels
    """
    share = np.repeat(photons / _WAVES, _WAVES)
    cycles = edges.pixel_scale * _ARCSEC / (edges.wavelength.ravel() * 1e-7)
    out = _LONG * np.arange(int(reach / _LONG) + 2)
    # Wider than it is kept: what the blur brings in.
    across = _STEP * np.arange(2 * round(_WIDE / _STEP))
    found = []
    for _, width, length in edges.bars:
        height = share * (width * length * cycles) ** 2 / edges.area
        along = np.sinc(width * cycles * out[:, None]) ** 2 * height
        found.append(_blurred(np.sinc(length * cycles[:, None] * across) ** 2, edges.blur / edges.pixel_scale, along))
    return np.stack(found)


def reach(edges: Edges, electrons: Float, least: float) -> Float:
    """float64[n] pixels as far as which a star's brightest spike has a pixel of `least` electrons, at most FARTHEST.

    Error : 15 %, of fringes along the spike, and of colours: sub-bands are taken as equal
    """
    share = 1.0 / edges.wavelength.size
    cycles = edges.pixel_scale * _ARCSEC / (edges.wavelength.ravel() * 1e-7)
    across, blur = _STEP * np.arange(2 * round(_WIDE / _STEP)), edges.blur / edges.pixel_scale
    # Of fringes whose mean is half of r^-2.
    middle = [
        float(_blurred(np.sinc(length * cycles[:, None] * across) ** 2, blur, np.full((1, len(cycles)), share))[0, 0])
        * (length / np.pi) ** 2
        / (2.0 * edges.area)
        for _, _, length in edges.bars
    ]
    farthest = FARTHEST / edges.pixel_scale
    return np.asarray(np.minimum(np.sqrt(max(middle) * electrons / max(least, 1e-300)), farthest))


def _blurred(lines: Float, blur: float, along: Float) -> Float:
    """Sum of the lines [w, t], t >= 0, through jitter, diffusion and pixel: [r, t] up to _WIDE."""
    both = np.concatenate([lines[:, :0:-1], lines], axis=1)
    k = 2.0 * np.pi * np.fft.rfftfreq(both.shape[1], _STEP)
    passed = np.fft.rfft(both, axis=1) * np.exp(-0.5 * (blur * k) ** 2) * np.sinc(k / (2.0 * np.pi))
    smooth = np.fft.irfft(passed, both.shape[1], axis=1)[:, lines.shape[1] - 1 :]
    return np.asarray(along @ np.maximum(smooth[:, : round(_WIDE / _STEP) + 2], 0.0))


def add(
    frame: Int,
    column: float,
    row: float,
    electrons: float,
    photons: Float | None,
    size: int,
    least: float,
    edges: Edges | None,
    trail: Float | None = None,
) -> None:
    """Adds what a star shines outside its plane, which fades by `left`, to a frame of 1 / FIXED_POINT electrons.

    photons : [w] share of each sub-band, None = equal;  size : of the plane, pixels
    least   : electrons in a pixel that may be left out
    trail   : [2] pixels that it moves by, with its plane; None: it is at rest
    """
    if edges is None:
        return
    photons, columns, rows, turned = _points(column, row, photons, edges, trail)
    points = len(columns)
    ny, nx = frame.shape
    # Beyond the farthest corner's pixel.
    farthest = float(np.hypot(max(columns.max() + 1.0, nx - columns.min()), max(rows.max() + 1.0, ny - rows.min())))
    level = electrons / points * ring(edges, photons)
    lines = electrons / points * spikes(edges, photons, max(farthest, edges.period))
    faintest = _FAINTEST * least / points
    radius = min((level / faintest) ** (1.0 / 3.0), farthest) if faintest > 0.0 else farthest
    inner = size / 2 - _SPARED
    # What a spike shows outside the plane: so far out, so wide.
    shown = lines[:, int(inner / _LONG) :] > faintest
    out, across = (np.flatnonzero(shown.any(axis=axes)) for axes in ((0, 2), (0, 1)))
    far = min(inner + _LONG * float(out[-1] + 1) if len(out) else 0.0, farthest)
    wide = _STEP * float(across[-1] + 1) if len(across) else 0.0
    for x, y in zip(columns.tolist(), rows.tolist(), strict=True):
        _outside(frame, x, y, inner, level, radius, turned, lines, far, wide)
        _inside(frame, x, y, inner, level, turned, lines)


def unfold(
    stamp: npt.NDArray[Any],
    left: int,
    low: int,
    nx: int,
    ny: int,
    column: float,
    row: float,
    electrons: float,
    photons: Float | None,
    size: int,
    least: float,
    edges: Edges | None,
    trail: Float | None = None,
) -> None:
    """Takes off a star's stamp, in place, what its plane's transform had folded into it: a fifth of its corners.

    left, low : the stamp's first pixel on a frame of nx, ny, outside which nothing is done;  others : as of `add`
    Of each pixel it is the share that folded light has in all that should be there: the two run through each other, and
    where they cancel there is less than of either.
    """
    if edges is None:
        return
    photons, columns, rows, turned = _points(column, row, photons, edges, trail)
    level, inner = electrons / len(columns) * ring(edges, photons), size / 2 - _SPARED
    if _FOLDED * level / inner**3 > _FAINTEST * least / len(columns):
        lines = electrons / len(columns) * spikes(edges, photons, edges.period)
        seen = stamp[max(-low, 0) : max(ny - low, 0), max(-left, 0) : max(nx - left, 0)]
        x, y = columns - max(left, 0), rows - max(low, 0)
        _unfold(seen, x, y, inner, level, turned, lines, edges.period)


def _points(
    column: float, row: float, photons: Float | None, edges: Edges, trail: Float | None
) -> tuple[Float, Float, Float, Float]:
    """(photons [w], columns and rows [p] of points that shine as a star and its trail do, bars' directions [b, 2])."""
    photons = np.full(len(edges.wavelength), 1.0 / len(edges.wavelength)) if photons is None else photons
    trail = np.zeros(2) if trail is None else trail
    points = max(math.ceil(float(np.hypot(*trail)) / _finest(edges)), 1)
    along = (np.arange(points) + 0.5) / points - 0.5
    turned = np.stack([np.cos(edges.bars[:, 0]), np.sin(edges.bars[:, 0])], axis=1)
    return photons, column + along * trail[0], row + along * trail[1], turned


def _finest(edges: Edges) -> float:
    """Pixels between points that shine as an even line does: across a spike no frequency is higher."""
    return float(edges.wavelength.min() * 1e-7 / edges.bars[:, 2].max() / (edges.pixel_scale * _ARCSEC))


def left(size: int, samples: int, count: int) -> Float:
    """float64[count] what a star's plane is multiplied with along each axis, to fade into `add`'s light.

    size : of the plane, pixels;  samples : a pixel;  count : of samples, its middle in the middle
    """
    distance = np.abs(np.arange(count) - count // 2) / samples
    return np.array([_left(float(d), size / 2 - _SPARED) for d in distance])


@jit
def _on_spike(turned: Any, lines: Any, b: int, dx: float, dy: float) -> Any:
    """Bar b's spike at an offset; turned : [b, 2] along the bar."""
    t = abs(dx * turned[b, 0] + dy * turned[b, 1]) / _STEP
    r = abs(dy * turned[b, 0] - dx * turned[b, 1]) / _LONG
    i, j = int(r), int(t)
    if i + 1 >= lines.shape[1] or j + 1 >= lines.shape[2]:
        return 0.0
    u, v = r - i, t - j
    near = (1.0 - v) * lines[b, i, j] + v * lines[b, i, j + 1]
    return (1.0 - u) * near + u * ((1.0 - v) * lines[b, i + 1, j] + v * lines[b, i + 1, j + 1])


@jit
def _outside(
    frame: Any, x: float, y: float, inner: float, level: float, radius: float, turned: Any, lines: Any, far: float,
    wide: float,
) -> None:  # fmt: skip
    """Adds what lies outside a square of half side `inner`: the ring up to `radius`, spikes up to `far`."""
    ny, nx = frame.shape
    for r in range(ny):
        dy = r - y
        own = abs(dy) < inner
        chord = np.sqrt(radius * radius - dy * dy) if abs(dy) < radius else -1.0
        for c in range(max(0, int(np.ceil(x - chord))), min(nx, int(np.floor(x + chord)) + 1)):
            if not (own and abs(c - x) < inner):
                square = (c - x) * (c - x) + dy * dy
                frame[r, c] += np.int64(np.rint(level / (square * np.sqrt(square)) * FIXED_POINT))
        for b in range(len(turned) if wide > 0.0 else 0):
            left, right = 0, nx
            if abs(turned[b, 0]) > 1e-9:
                middle, half = x - dy * turned[b, 1] / turned[b, 0], wide / abs(turned[b, 0])
                left, right = int(max(middle - half, 0.0)), int(min(max(middle + half, -1.0), nx - 1.0)) + 1
            for c in range(left, right):
                if not (own and abs(c - x) < inner) and (c - x) * (c - x) + dy * dy < far * far:
                    frame[r, c] += np.int64(np.rint(_on_spike(turned, lines, b, c - x, dy) * FIXED_POINT))


@jit
def _inside(frame: Any, x: float, y: float, inner: float, level: float, turned: Any, lines: Any) -> None:
    """Adds what has faded of the plane, inside the square."""
    ny, nx = frame.shape
    for r in range(max(int(np.ceil(y - inner)), 0), min(int(np.ceil(y + inner)), ny)):
        for c in range(max(int(np.ceil(x - inner)), 0), min(int(np.ceil(x + inner)), nx)):
            dx, dy = c - x, r - y
            if abs(dx) < inner and abs(dy) < inner:
                left = _left(abs(dx), inner) * _left(abs(dy), inner)
                if left < 1.0:
                    frame[r, c] += np.int64(np.rint((1.0 - left) * _light(dx, dy, level, turned, lines) * FIXED_POINT))


@jit
def _unfold(stamp: Any, x: Float, y: Float, inner: float, level: float, turned: Any, lines: Any, period: float) -> None:
    """Multiplies a stamp by what is not folded of the light that points at x, y send to each pixel."""
    for r in range(stamp.shape[0]):
        for c in range(stamp.shape[1]):
            folded = 0.0
            for p in range(len(x)):
                dx, dy = c - x[p], r - y[p]
                if abs(dx) < inner and abs(dy) < inner and dx * dx + dy * dy > (_NEAR * period) ** 2:
                    left = _left(abs(dx), inner) * _left(abs(dy), inner)
                    folded += left * _folded(dx, dy, level, turned, lines, period)
            if folded > 0.0:
                own = 0.0
                for p in range(len(x)):
                    dx, dy = c - x[p], r - y[p]
                    left = _left(abs(dx), inner) * _left(abs(dy), inner)
                    own += left * _light(dx, dy, level, turned, lines)
                stamp[r, c] *= own / (own + folded)


@jit
def _left(distance: float, inner: float) -> Any:
    """Of the plane's light, pixels from its middle along one axis: a smooth step."""
    z = min(max((inner - distance) / _FADING, 0.0), 1.0)
    return z * z * (3.0 - 2.0 * z)


@jit
def _light(dx: float, dy: float, level: float, turned: Any, lines: Any) -> Any:
    """What a star shines in a pixel at an offset."""
    square = dx * dx + dy * dy
    light = level / (square * np.sqrt(square))
    for b in range(len(turned)):
        light += _on_spike(turned, lines, b, dx, dy)
    return light


@jit
def _folded(dx: float, dy: float, level: float, turned: Any, lines: Any, period: float) -> Any:
    """What of it the plane has that lies a period away; the pupil's soft edges had weakened that by sinc^2."""
    total = 0.0
    for up in range(-1, 2):
        for right in range(-1, 2):
            ax, ay = dx + right * period, dy + up * period
            square = ax * ax + ay * ay
            # From farther away than a period next to nothing has passed.
            if (up != 0 or right != 0) and square < period * period:
                total += _light(ax, ay, level, turned, lines) * _passed(np.sqrt(square) / period)
    return total / _passed(np.sqrt(dx * dx + dy * dy) / period)


@jit
def _passed(angle: float) -> Any:
    turn = np.pi * angle
    return (np.sin(turn) / turn) ** 2 if turn > 1e-6 else 1.0
