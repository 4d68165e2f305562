"""Drawing spectra: every source's light, spread along the traces of a grism's orders, summed onto a frame.

Order             a trace, and what it detects of a photon
Settings          what decides how much of a spectrum is drawn;  settings_for : an accuracy
Dispersed         what a grism makes of sources
draw              sources -> frame;  Tally : with what each brought, by order

A galaxy that no stamp holds is drawn in two parts (giants.py), a trail in pieces, each on a stamp of its own.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from lake_schema.arrays import Float, Float32, Int
from truesky.render.camera.traces import Trace
from truesky.render.dispersing import giants, images, kernels, spreading
from truesky.render.dispersing.images import Planes, Sampling
from truesky.render.dispersing.stamp_sizes import GIANTS, Sizes
from truesky.render.drawing import stamps, transfer
from truesky.render.drawing.kernels.frame import FIXED_POINT
from truesky.render.psf.model import Psf
from truesky.render.sources.source_list import Sources
from truesky.request.accuracy import Accuracy

# Sources whose spectra are held at a time, and samples of their images.
_TOGETHER, _HELD = 256, 1 << 17
# Places at which it is seen where a trace goes, and whether it is straight: its slope, rows a column, is nowhere
# farther from that of all. Of wings as r^-3, moved by a first derivative, that leaves 6 times its square: 0.5 %.
_PLACES, _STRAIGHT = 33, 0.03
# Rows a column up to which images are sheared: they ring by 7e-5 of their peak at 4 deg, 2e-4 at 8, 2e-3 at 30.
_STEEPEST = 0.15
# Of the largest stamp, that an order must want to be drawn on it, too.
_SHARED = 0.6


@dataclass(frozen=True, slots=True)
class Order:
    """Where an order puts light, and how much of it is detected.

    response : float64[w] electrons for each unit of the spectrum at whole angstroms from `first`; below 0 they are
               taken off
    """

    trace: Trace
    first: int
    response: Float

    @property
    def wavelength(self) -> Float:
        """float64[w] A."""
        return self.first + np.arange(float(len(self.response)))


@dataclass(frozen=True, slots=True)
class Settings:
    """What decides how much of a spectrum is drawn, and how finely.

    edge   : largest light in a row at a stamp's edge, of a pixel's noise
    faint  : an order whose brightest column has less of a pixel's noise is not drawn; the first, if less than `edge`
    least  : smallest side of a stamp, pixels
    along, across : samples a pixel of a stamp
    block  : A of a spectrum that share one PSF; 0: each has its own, and its own rows, which is slow
    nodes  : wavelengths that the PSF is computed at;  positions : places of it on a detector, one of euclid.DEGREES
    """

    edge: float = 0.003
    faint: float = 0.01
    least: int = 24
    along: int = 2
    across: int = 3
    block: float = 110.0
    nodes: int = 4
    positions: int = 9


# What it is for, of a pixel's noise, and as measured by benchmarks/_dispersion.py.
TABLE = Path(__file__).with_name("settings.csv")


@cache
def settings_for(wanted: Accuracy) -> Settings:
    """The cheapest settings that are for an accuracy, else the best."""
    known = rows()
    return of_row(next((row for row in known if row["allowed"] <= wanted.background), known[-1]))


def rows() -> list[dict[str, float]]:
    """The table of settings, the cheapest first."""
    with TABLE.open(newline="", encoding="utf-8") as lines:
        read = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    found = [{name: float(value) for name, value in row.items()} for row in read]
    return sorted(found, key=lambda row: -row["allowed"])


def of_row(row: dict[str, float]) -> Settings:
    """Of a row of the table."""
    known: dict[str, Any] = {name: row[name] for name in ("edge", "faint", "block")}
    known |= {name: int(row[name]) for name in ("least", "along", "across", "nodes", "positions")}
    return Settings(**known)


Spectra = Callable[[Int], Float32]
# Of a PSF, by how stamps are sampled.
Known = dict[Sampling, Planes]


@dataclass(frozen=True, slots=True)
class Dispersed:
    """What a grism makes of sources.

    spectra : of some of the sources, float32[n, w] at the wavelengths of the orders
    orders  : of one grism, with the same wavelengths;  settings : of drawing
    """

    spectra: Spectra
    orders: tuple[Order, ...]
    settings: Settings


@dataclass(frozen=True, slots=True)
class Tally:
    """What each source brought, filled by `draw`.

    electrons : float64[n, orders] that fell onto the frame;  expected : on it and beside it
    peak      : float64[n, orders] e- of its brightest column, where some of it is drawn
    sizes     : int64[n] side of its largest stamp, pixels; 0 = none was drawn
    """

    electrons: Float
    expected: Float
    peak: Float
    sizes: Int

    @classmethod
    def of(cls, sources: int, orders: int) -> Tally:
        """Of so many sources and orders, before anything is drawn."""
        shape = sources, orders
        return cls(np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(sources, np.int64))

    def add(self, pieces: Tally, whole: Int) -> None:
        """Of pieces [p] of sources `whole` [p]."""
        np.add.at(self.electrons, whole, pieces.electrons)
        np.add.at(self.expected, whole, pieces.expected)
        np.add.at(self.peak, whole, pieces.peak)
        np.maximum.at(self.sizes, whole, pieces.sizes)


def draw(
    sources: Sources, dispersed: Dispersed, psf: Psf, shape: tuple[int, int], noise: float,
    tally: Tally | None = None, layers: dict[int, Float] | None = None, known: Known | None = None,
) -> Float:  # fmt: skip
    """Expected electrons of the sources alone, float64[ny, nx].

    sources   : places of their undispersed images, pixels, and their shapes
    dispersed : their spectra, and where they lie;  psf : its wavelengths are the nodes
    shape     : ny, nx;  noise : of a pixel, e-;  tally : to be filled
    layers    : to be filled with the frame of each order, whose sum the result is; None: they are not told apart
    known     : what calls with the same PSF and orders share, filled on the way
    """
    frames = [np.zeros(shape, np.int64)]
    orders, settings = dispersed.orders, dispersed.settings
    if layers is not None:
        frames += [np.zeros(shape, np.int64) for _ in orders[1:]]
    onto = frames if layers is not None else frames * len(orders)
    slope = _slope(next((order for order in orders if order.trace.order == 1), orders[0]).trace)
    # What moves far is drawn in pieces, each with a part of the light.
    pieces, trail, whole = stamps.in_pieces(sources)
    pieces = pieces if sources.trail is None else replace(pieces, trail=trail)
    sizes = Sizes.of(pieces, psf, settings.edge * noise, settings.least)
    plans = [_Plan.of(order, psf, settings, slope) for order in orders]
    # Orders share images: where one of them is straight, in the coordinates in which it is a row.
    straight = any(plan.tile > 0 for plan in plans)
    seen = _Seen(pieces, psf, sizes, settings, (slope, straight), shape, {} if known is None else known)
    own = Tally.of(len(pieces), len(orders))
    for start in range(0, len(pieces), _TOGETHER):
        some = np.arange(start, min(start + _TOGETHER, len(pieces)))
        spectra = dispersed.spectra(whole[some])
        parts = [_Part.of(seen, some, spectra, plan, shape) for plan in plans]
        for column, part in enumerate(parts):
            own.expected[some, column] = part.expected
            own.peak[some, column] = np.where(part.sizes > 0, part.peak, 0.0)
        _add(seen, some, spectra, list(zip(plans, parts, strict=True)), onto, own)
    if tally is not None:
        tally.add(own, whole)
    if layers is not None:
        layers.update({order.trace.order: frame / FIXED_POINT for order, frame in zip(orders, frames, strict=True)})
    # Of whole numbers: the same whether orders are told apart or not.
    return sum(frames[1:], frames[0]) / FIXED_POINT


def _slope(trace: Trace) -> float:
    """Rows a column along the first order, at the middle of the detector: of all orders, but for their curvature.

    0 where light is not spread along the columns.
    """
    along, across = (float(part[1:].sum()) for part in trace.polynomials(0.0, 0.0))
    return across / along if abs(along) > abs(across) else 0.0


@dataclass(frozen=True, slots=True)
class _Plan:
    """What of an order is the same for all sources.

    angstrom : of a pixel along the trace;  tile : pixels that share a PSF, where it is straight; 0 = it never is
    share    : float64[w, b] of the PSF's wavelengths
    t        : of the first wavelength, and from one to the next
    """

    order: Order
    angstrom: float
    tile: int
    share: Float
    t: tuple[float, float]

    @classmethod
    def of(cls, order: Order, psf: Psf, settings: Settings, slope: float) -> _Plan:
        assert psf.planes is not None
        along, _ = order.trace.polynomials(0.0, 0.0)
        length = max(abs(float(along[1:].sum())), 1e-6) * float(np.hypot(1.0, slope))
        angstrom = (order.trace.last - order.trace.first) / length
        tile = 0
        if settings.block >= 0.5 * spreading.STEP * angstrom and abs(slope) <= _STEEPEST:
            tile = spreading.STEP * max(round(settings.block / angstrom / spreading.STEP), 1)
        step = 1.0 / (order.trace.last - order.trace.first)
        t = (order.first - order.trace.first) * step, step
        return cls(order, angstrom, tile, images.shares(order.wavelength, psf.planes.wavelength), t)


@dataclass(frozen=True, slots=True)
class _Part:
    """One order of some of the sources, [k] each.

    along, across : float64[k, i] polynomials of their traces
    sizes    : of their stamps, 0 = nothing of it is drawn
    tiles    : pixels that share a PSF; 0 where the trace is not straight
    expected : electrons, on the frame and beside it;  peak : in the brightest column
    """

    along: Float
    across: Float
    sizes: Int
    tiles: Int
    expected: Float
    peak: Float

    @classmethod
    def of(cls, seen: _Seen, some: Int, spectra: Float32, plan: _Plan, shape: tuple[int, int]) -> _Part:
        order, (ny, nx), count = plan.order, shape, len(some)
        column, row = seen.sources.column[some], seen.sources.row[some]
        peak, expected = np.empty(count), np.empty(count)
        window = max(round(plan.angstrom), 1)
        kernels.brightest(spectra, seen.sources.electrons[some], order.response, window, peak, expected)
        along, across = (part.T for part in order.trace.polynomials(column, row))
        t = plan.t[0] + plan.t[1] * np.linspace(0.0, len(order.response) - 1.0, _PLACES)
        x, y = (np.polynomial.polynomial.polyval(t, part.T) for part in (along, across))
        limit = seen.sizes.limit * (1.0 if order.trace.order == 1 else seen.settings.faint / seen.settings.edge)
        sizes = seen.sizes.size(some, peak, expected)
        left, right = column + x.min(axis=1), column + x.max(axis=1)
        low, high = row + y.min(axis=1), row + y.max(axis=1)
        beside = (right + sizes < 0) | (left - sizes > nx) | (high + sizes < 0) | (low - sizes > ny)
        across_step, along_step = np.diff(y, axis=1), np.diff(x, axis=1)
        straight = (np.abs(across_step - seen.slope * along_step) <= _STRAIGHT * np.abs(along_step)).all(axis=1)
        straight &= (along_step > 0.0).all(axis=1) | (along_step < 0.0).all(axis=1)
        nothing = beside | (peak < limit) | (peak <= 0.0)
        return cls(
            np.ascontiguousarray(along), np.ascontiguousarray(across), np.where(nothing, 0, sizes),
            np.where(straight, plan.tile, 0), expected, peak,
        )  # fmt: skip


class _Seen:
    """Sources through the PSF."""

    def __init__(
        self, sources: Sources, psf: Psf, sizes: Sizes, settings: Settings, slope: tuple[float, bool],
        shape: tuple[int, int], known: Known,
    ) -> None:  # fmt: skip
        self.sources, self.psf, self.sizes, self.settings = sources, psf, sizes, settings
        self.slope, self.straight = slope
        self.places = list(zip(sources.column.tolist(), sources.row.tolist(), strict=True))
        self.bodies = images.bodies(sources, self.slope if self.straight else 0.0)
        assert psf.planes is not None
        count = len(psf.planes.wavelength)
        # How the PSF changes is known on the detector alone.
        column, row = np.clip(sources.column, 0.0, shape[1] - 1.0), np.clip(sources.row, 0.0, shape[0] - 1.0)
        one = [transfer.basis_weights(psf, np.tile(part, (len(sources), 1)), column, row) for part in np.eye(count)]
        self.weights = np.stack(one, axis=1)
        self._planes = known

    def sampling(self, size: int, smooth: bool = False) -> Sampling:
        """Of stamps of `size` pixels; smooth : of what giants.add draws."""
        like = Sampling(size, self.settings.along, self.settings.across, self.slope, self.straight)
        return giants.sampling(size, like, smooth)

    def images(self, some: Int, sampling: Sampling) -> Float32:
        """Coefficients [m, b, n along, n across] of sources on stamps."""
        if sampling not in self._planes:
            self._planes[sampling] = images.planes(self.psf, sampling)
        own = self._planes[sampling]
        over = [images.spread_over(own, self.sources, i) for i in some.tolist()]
        return images.coefficients(own, self.weights[some], self.bodies.take(some), over)

    def together(self, sampling: Sampling) -> int:
        """How many stamps are held at a time."""
        samples = self.weights.shape[1] * sampling.n**2 * sampling.along * sampling.across
        return max(int(_HELD // samples), 1)


def _add(
    seen: _Seen, some: Int, spectra: Float32, orders: list[tuple[_Plan, _Part]], onto: list[Int], tally: Tally
) -> None:
    """Orders of some of the sources onto their frames."""
    sizes = np.stack([part.sizes for _, part in orders])
    # Orders that want stamps of nearly one size share the largest.
    largest = sizes.max(axis=0)
    sizes = np.where((sizes > 0) & (sizes >= _SHARED * largest), largest, sizes)
    tally.sizes[some] = np.maximum(tally.sizes[some], largest)
    for size in np.unique(sizes[sizes > 0]).tolist():
        sampling = seen.sampling(size)
        smooth = seen.sampling(size, smooth=True) if size >= GIANTS[0] else None
        which, count = np.flatnonzero((sizes == size).any(axis=0)), seen.together(sampling)
        for own in np.split(which, range(count, len(which), count)):
            for k, image in zip(own.tolist(), seen.images(some[own], sampling), strict=True):
                i = int(some[k])
                rest = None if smooth is None else seen.images(some[k : k + 1], smooth)[0]
                for m in np.flatnonzero(sizes[:, k] == size).tolist():
                    plan, part = orders[m]
                    light = spectra[k], float(seen.sources.electrons[i]), plan.order.response
                    path, place = (part.along[k], part.across[k]), seen.places[i]
                    fallen = spreading.spread(
                        image, *light, plan.share, *path, plan.t, place, *sampling.rows, sampling.shape,
                        int(part.tiles[k]), FIXED_POINT, onto[m],
                    )  # fmt: skip
                    if smooth is not None and rest is not None:
                        fallen += giants.add(rest, light, plan.share, path, plan.t, place, smooth, onto[m])
                    tally.electrons[i, m] = fallen
