"""Light that the pupil's edges diffract far from a bright star, where its PSF's plane has ended.

So far out the rings of a band's wavelengths overlap: what is left of them falls as r^-3. Each straight bar draws two
spikes across itself, as wide as it is long, with the fringes of its width along them.

Edges     of a pupil;  of_pupil : the Euclid one's
add       what a star shines outside the plane, onto a frame
unfold    what of it the plane has inside, taken off
reach     how far out a star's spikes are noticed
left      how the plane fades there
seconds, unfold_seconds   what `add` and `unfold` take

Ref : Born & Wolf, Principles of Optics, sections 8.5.1 (a straight bar) and 8.5.2 (a circle, far out)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from jobs import sums
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
# Of a trail's piece, the pixels that count as a point where a plane is unfolded; its spikes as a line.
_PART = 16.0
# Points along a bar that tell how much of it is seen.
_POINTS = 7001
# CPU s, measured (2.5 GHz, one core), of a frame's pixel: about a star, a trail, and for each pixel of its length; and
# of a stamp's pixel and part of a piece.
_STAR_S, _TRAIL_S, _LONGER_S, _UNFOLD_S = 7e-9, 8e-8, 4e-10, 1.2e-7
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
    wavelength = float(sums.product(photons, edges.wavelength.mean(axis=1))) * 1e-7
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
    return np.asarray(sums.product(along, np.maximum(smooth[:, : round(_WIDE / _STEP) + 2], 0.0)))


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
    unit: float = FIXED_POINT,
) -> None:
    """Adds what a star shines outside its plane, which fades by `left`, to a frame that has `unit` of an electron.

    photons : [w] share of each sub-band, None = equal;  size : of the plane, pixels
    least   : electrons in a pixel that may be left out
    trail   : [2] pixels that it moves by, with its plane, (column, row) in its middle; None: it is at rest
    """
    if edges is None:
        return
    photons, turned, length, along = _seen(photons, edges, trail)
    ny, nx = frame.shape
    ends = np.array([-0.5, 0.5]) * length
    columns, rows = column + ends * along[0], row + ends * along[1]
    # Beyond the farthest corner's pixel.
    farthest = float(np.hypot(max(columns.max() + 1.0, nx - columns.min()), max(rows.max() + 1.0, ny - rows.min())))
    if length > 0.0:
        farthest = min(farthest, FARTHEST / edges.pixel_scale)
    level = electrons * ring(edges, photons)
    lines = electrons * spikes(edges, photons, max(farthest, edges.period))
    faintest = _FAINTEST * least
    radius = min((level / faintest) ** (1.0 / 3.0), farthest) if faintest > 0.0 else farthest
    inner = size / 2 - _SPARED
    # What a spike shows outside the plane: so far out, so wide.
    shown = lines[:, int(inner / _LONG) :] > faintest
    out, across = (np.flatnonzero(shown.any(axis=axes)) for axes in ((0, 2), (0, 1)))
    far = min(inner + _LONG * float(out[-1] + 1) if len(out) else 0.0, farthest)
    wide = _STEP * float(across[-1] + 1) if len(across) else 0.0
    level, lines = level * unit, lines * unit
    if length > 0.0:
        lines /= length
        fine = length / math.ceil(length / _finest(edges))
        _streak(
            frame,
            column,
            row,
            *along,
            length,
            inner,
            level / length,
            radius,
            turned,
            lines,
            _sums(lines),
            far,
            wide,
            fine,
        )
        return
    _outside(frame, column, row, inner, level, radius, turned, lines, far, wide)
    _inside(frame, column, row, inner, level, turned, lines)


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
    photons, turned, length, along = _seen(photons, edges, trail)
    level, inner = electrons * ring(edges, photons), size / 2 - _SPARED
    if _FOLDED * level / inner**3 > _FAINTEST * least:
        lines = electrons * spikes(edges, photons, edges.period) / (length or 1.0)
        seen = stamp[max(-low, 0) : max(ny - low, 0), max(-left, 0) : max(nx - left, 0)]
        parts = max(math.ceil(length / _PART), 1)
        places = length * ((np.arange(parts) + 0.5) / parts - 0.5)
        x, y = column - max(left, 0) + places * along[0], row - max(low, 0) + places * along[1]
        _unfold(seen, x, y, *along, length / parts, inner, level / parts, turned, lines, _sums(lines), edges.period)


def seconds(length: Float, nx: int, ny: int) -> float:
    """CPU s that `add` takes for trails of lengths, pixels, of which 0 are at rest.

    Error : half and twice; less where little of them is noticed
    """
    longer = np.minimum(length, nx + ny)
    return float(np.where(length > 0.0, _TRAIL_S + _LONGER_S * longer, _STAR_S).sum()) * nx * ny


def unfold_seconds(length: Float, sizes: Int) -> float:
    """CPU s that `unfold` takes for pieces of trails on stamps of sides, pixels."""
    return float((_UNFOLD_S * sizes.astype(float) ** 2 * np.maximum(np.ceil(length / _PART), 1.0)).sum())


def _seen(photons: Float | None, edges: Edges, trail: Float | None) -> tuple[Float, Float, float, tuple[float, float]]:
    """(photons [w], bars' directions [b, 2], a trail's length, pixels, 0 if it is as good as a point; direction)."""
    photons = np.full(len(edges.wavelength), 1.0 / len(edges.wavelength)) if photons is None else photons
    turned = np.stack([np.cos(edges.bars[:, 0]), np.sin(edges.bars[:, 0])], axis=1)
    length = 0.0 if trail is None else float(np.hypot(*trail))
    if trail is None or length <= _finest(edges):
        return photons, turned, 0.0, (0.0, 0.0)
    return photons, turned, length, (float(trail[0]) / length, float(trail[1]) / length)


def _sums(lines: Float) -> Float:
    """Of a spike's table from its middle outward, pixels times its unit."""
    whole = np.zeros(lines.shape)
    np.cumsum(0.5 * _STEP * (lines[:, :, 1:] + lines[:, :, :-1]), axis=2, out=whole[:, :, 1:])
    return whole


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
    """Adds what lies outside a square of half side `inner`: the ring up to `radius`, spikes up to `far`.

    level, lines : in the frame's units, as below
    """
    ny, nx = frame.shape
    for r in range(ny):
        dy = r - y
        own = abs(dy) < inner
        chord = np.sqrt(radius * radius - dy * dy) if abs(dy) < radius else -1.0
        for c in range(max(0, int(np.ceil(x - chord))), min(nx, int(np.floor(x + chord)) + 1)):
            if not (own and abs(c - x) < inner):
                square = (c - x) * (c - x) + dy * dy
                frame[r, c] += np.int64(np.rint(level / (square * np.sqrt(square))))
        for b in range(len(turned) if wide > 0.0 else 0):
            left, right = 0, nx
            if abs(turned[b, 0]) > 1e-9:
                middle, half = x - dy * turned[b, 1] / turned[b, 0], wide / abs(turned[b, 0])
                left, right = int(max(middle - half, 0.0)), int(min(max(middle + half, -1.0), nx - 1.0)) + 1
            for c in range(left, right):
                if not (own and abs(c - x) < inner) and (c - x) * (c - x) + dy * dy < far * far:
                    frame[r, c] += np.int64(np.rint(_on_spike(turned, lines, b, c - x, dy)))


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
                    frame[r, c] += np.int64(
                        np.rint((1.0 - left) * _light(dx, dy, level, turned, lines, lines, 0.0, 0.0, 0.0))
                    )


@jit
def _streak(
    frame: Any, x: float, y: float, ux: float, uy: float, length: float, inner: float, level: float, radius: float,
    turned: Any, lines: Any, sums: Any, far: float, wide: float, fine: float,
) -> None:  # fmt: skip
    """Adds what `_outside` and `_inside` add of each point of a trail along (ux, uy) about x, y.

    level, lines : of a pixel of the trail;  fine : pixels between points in the square's border, where light fades
    """
    ny, nx = frame.shape
    end, core = 0.5 * length, inner - _FADING
    for r in range(ny):
        for c in range(nx):
            dx, dy = c - x, r - y
            # The points in whose square the pixel lies, and those in whose square's border.
            first, last = _covering(dx, dy, ux, uy, inner, end)
            light = 0.0
            nearest = min(max(dx * ux + dy * uy, -end), end)
            if (dx - nearest * ux) ** 2 + (dy - nearest * uy) ** 2 < radius * radius:
                light += level * (_ring_of(dx, dy, ux, uy, -end, first) + _ring_of(dx, dy, ux, uy, last, end))
            for b in range(len(turned) if wide > 0.0 else 0):
                for low, high in ((-end, first), (last, end)):
                    light += _spike_of(turned, lines, sums, b, dx, dy, ux, uy, low, high, far, wide)
            if first < last:
                start, stop = _covering(dx, dy, ux, uy, core, end)
                if start >= stop:
                    start, stop = last, last
                for low, high in ((first, start), (stop, last)):
                    points = int(np.ceil((high - low) / fine))
                    for p in range(points):
                        s = low + (high - low) * (p + 0.5) / points
                        ax, ay = dx - s * ux, dy - s * uy
                        faded = 1.0 - _left(abs(ax), inner) * _left(abs(ay), inner)
                        # No trail, its sums are not asked for.
                        light += faded * _light(ax, ay, level, turned, lines, sums, ux, uy, 0.0) * (high - low) / points
            if light > 0.0:
                frame[r, c] += np.int64(np.rint(light))


@jit
def _covering(dx: float, dy: float, ux: float, uy: float, half: float, end: float) -> Any:
    """Where along a trail, from -end to end, a pixel is within `half` of it in columns and in rows; else end, end."""
    low, high = -end, end
    for d, u in ((dx, ux), (dy, uy)):
        if abs(u) > 1e-9:
            low, high = max(low, d / u - half / abs(u)), min(high, d / u + half / abs(u))
        elif abs(d) >= half:
            return end, end
    return (low, high) if low < high else (end, end)


@jit
def _ring_of(dx: float, dy: float, ux: float, uy: float, low: float, high: float) -> Any:
    """Integral of r^-3 over a trail from `low` to `high`, in forms that lose no digits on its own line."""
    if low >= high:
        return 0.0
    along, beside = dx * ux + dy * uy, dx * uy - dy * ux
    a, b = low - along, high - along
    if a < 0.0 < b:
        square = beside * beside
        return (b / np.hypot(b, beside) - a / np.hypot(a, beside)) / square
    if b <= 0.0:
        a, b = -b, -a
    near, away = np.hypot(a, beside), np.hypot(b, beside)
    return 1.0 / (near * (near + a)) - 1.0 / (away * (away + b))


@jit
def _spike_of(
    turned: Any, lines: Any, sums: Any, b: int, dx: float, dy: float, ux: float, uy: float, low: float, high: float,
    far: float, wide: float,
) -> Any:  # fmt: skip
    """Integral of bar b's spike over a trail from `low` to `high`, as far as it lies within `far` and `wide`."""
    t, ut = dx * turned[b, 0] + dy * turned[b, 1], ux * turned[b, 0] + uy * turned[b, 1]
    r, ur = dy * turned[b, 0] - dx * turned[b, 1], uy * turned[b, 0] - ux * turned[b, 1]
    for d, u, half in ((t, ut, wide), (r, ur, far)):
        if abs(u) > 1e-9:
            low, high = max(low, d / u - half / abs(u)), min(high, d / u + half / abs(u))
        elif abs(d) >= half:
            return 0.0
    if low >= high:
        return 0.0
    total, parts = 0.0, int((high - low) * abs(ur) / _LONG) + 1
    step = (high - low) / parts
    for p in range(parts):
        s = low + (p + 0.5) * step
        out, across = abs(r - s * ur), t - s * ut
        passed = step * abs(ut)
        if passed > 0.1 * _STEP:
            side = 0.5 * passed
            total += (
                step
                / passed
                * (_sum_at(lines, sums, b, out, across + side) - _sum_at(lines, sums, b, out, across - side))
            )
        else:
            total += step * _on_spike(turned, lines, b, dx - s * ux, dy - s * uy)
    return total


@jit
def _sum_at(lines: Any, sums: Any, b: int, r: float, t: float) -> Any:
    """Integral across bar b's spike from its middle to t, of the table's straight pieces."""
    i, j = int(r / _LONG), int(abs(t) / _STEP)
    if i + 1 >= lines.shape[1]:
        return 0.0
    j = min(j, lines.shape[2] - 2)
    u, v = r / _LONG - i, min(abs(t) / _STEP - j, 1.0)
    near = sums[b, i, j] + _STEP * v * (lines[b, i, j] + 0.5 * v * (lines[b, i, j + 1] - lines[b, i, j]))
    away = sums[b, i + 1, j] + _STEP * v * (
        lines[b, i + 1, j] + 0.5 * v * (lines[b, i + 1, j + 1] - lines[b, i + 1, j])
    )
    found = (1.0 - u) * near + u * away
    return found if t >= 0.0 else -found


@jit
def _unfold(
    stamp: Any, x: Float, y: Float, ux: float, uy: float, length: float, inner: float, level: float, turned: Any,
    lines: Any, sums: Any, period: float,
) -> None:  # fmt: skip
    """Multiplies a stamp by what is not folded of the light that points at x, y send to each pixel.

    length : that each of them stands for, of a trail along (ux, uy): as of `_light`
    """
    for r in range(stamp.shape[0]):
        for c in range(stamp.shape[1]):
            folded = 0.0
            for p in range(len(x)):
                dx, dy = c - x[p], r - y[p]
                if abs(dx) < inner and abs(dy) < inner and dx * dx + dy * dy > (_NEAR * period) ** 2:
                    left = _left(abs(dx), inner) * _left(abs(dy), inner)
                    folded += left * _folded(dx, dy, level, turned, lines, sums, ux, uy, length, period)
            if folded > 0.0:
                own = 0.0
                for p in range(len(x)):
                    dx, dy = c - x[p], r - y[p]
                    left = _left(abs(dx), inner) * _left(abs(dy), inner)
                    own += left * _light(dx, dy, level, turned, lines, sums, ux, uy, length)
                stamp[r, c] *= own / (own + folded)


@jit
def _left(distance: float, inner: float) -> Any:
    """Of the plane's light, pixels from its middle along one axis: a smooth step."""
    z = min(max((inner - distance) / _FADING, 0.0), 1.0)
    return z * z * (3.0 - 2.0 * z)


@jit
def _light(
    dx: float, dy: float, level: float, turned: Any, lines: Any, sums: Any, ux: float, uy: float, length: float
) -> Any:
    """What a star shines in a pixel at an offset; or a short trail of a length along (ux, uy), lines of its pixel."""
    square = dx * dx + dy * dy
    light = level / (square * np.sqrt(square))
    for b in range(len(turned)):
        if length > 0.0:
            light += _spike_of(turned, lines, sums, b, dx, dy, ux, uy, -0.5 * length, 0.5 * length, np.inf, 1.0 * _WIDE)
        else:
            light += _on_spike(turned, lines, b, dx, dy)
    return light


@jit
def _folded(
    dx: float, dy: float, level: float, turned: Any, lines: Any, sums: Any, ux: float, uy: float, length: float,
    period: float,
) -> Any:  # fmt: skip
    """What of it the plane has that lies a period away; the pupil's soft edges had weakened that by sinc^2."""
    total = 0.0
    for up in range(-1, 2):
        for right in range(-1, 2):
            ax, ay = dx + right * period, dy + up * period
            square = ax * ax + ay * ay
            # From farther away than a period next to nothing has passed.
            if (up != 0 or right != 0) and square < period * period:
                passed = _passed(np.sqrt(square) / period)
                total += _light(ax, ay, level, turned, lines, sums, ux, uy, length) * passed
    return total / _passed(np.sqrt(dx * dx + dy * dy) / period)


@jit
def _passed(angle: float) -> Any:
    turn = np.pi * angle
    return (np.sin(turn) / turn) ** 2 if turn > 1e-6 else 1.0
