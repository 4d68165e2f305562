"""Drawing spectra: every source's light, spread along the traces of a grism's orders, summed onto a frame.

Order             a trace, and what it detects of a photon
Settings          what decides how much of a spectrum is drawn;  settings_for : an accuracy
Dispersed         what a grism makes of sources
draw              sources -> frame;  Tally : with what each brought, by order
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from jobs import sums
from jobs.accuracy import Accuracy
from jobs.render.camera.traces import Trace
from jobs.render.dispersing import images, kernels
from jobs.render.dispersing.images import Planes, Sampling
from jobs.render.drawing import transfer
from jobs.render.drawing.kernels.frame import FIXED_POINT
from jobs.render.psf.model import Psf
from jobs.render.sources import galaxy_shapes
from jobs.render.sources.source_list import Sources
from lake_schema.arrays import Bool, Float, Float32, Int

# Sides of stamps whose transforms are fast.
SIZES = np.array([16, 20, 24, 28, 32, 36, 40, 48, 56, 64, 80, 96, 128, 160, 192, 256, 320, 384, 512])
# Sources whose spectra are held at a time, and samples of their images.
_TOGETHER, _HELD = 256, 1 << 17
# Places at which it is seen where a trace goes, and whether it is straight: its slope, rows a column, is nowhere
# farther from that of all.
_PLACES, _STRAIGHT = 33, 0.03
# Rows a column up to which images are sheared: they ring by 7e-5 of their peak at 4 deg, 2e-4 at 8, 2e-3 at 30.
_STEEPEST = 0.15
# Of the largest stamp, that an order must want to be drawn on it, too.
_SHARED = 0.6
# Of a galaxy's half-light radius, that its stamp is wider than a point's.
_EXTENT = 6.0


@dataclass(frozen=True, slots=True)
class Order:
    """Where an order puts light, and how much of it is detected.

    response : float64[w] electrons for each unit of the spectrum at whole angstroms from `first`
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


def draw(
    sources: Sources, dispersed: Dispersed, psf: Psf, shape: tuple[int, int], noise: float,
    tally: Tally | None = None, layers: dict[int, Float] | None = None,
) -> Float:  # fmt: skip
    """Expected electrons of the sources alone, float64[ny, nx].

    sources   : places of their undispersed images, pixels, and their shapes
    dispersed : their spectra, and where they lie;  psf : its wavelengths are the nodes
    shape     : ny, nx;  noise : of a pixel, e-;  tally : to be filled
    layers    : to be filled with the frame of each order, whose sum the result is; None: they are not told apart
    """
    frames = [np.zeros(shape, np.int64)]
    orders, settings = dispersed.orders, dispersed.settings
    if layers is not None:
        frames += [np.zeros(shape, np.int64) for _ in orders[1:]]
    onto = frames if layers is not None else frames * len(orders)
    slope = _slope(orders[0].trace)
    seen = _Seen(sources, psf, Sizes.of(psf, noise, settings), settings, slope, shape)
    plans = [_Plan.of(order, psf, settings, slope) for order in orders]
    tally = tally or Tally.of(len(sources), len(orders))
    for start in range(0, len(sources), _TOGETHER):
        some = np.arange(start, min(start + _TOGETHER, len(sources)))
        spectra = dispersed.spectra(some)
        parts = [_Part.of(seen, some, spectra, plan, shape) for plan in plans]
        for column, part in enumerate(parts):
            tally.expected[some, column] = part.expected
            tally.peak[some, column] = np.where(part.sizes > 0, part.peak, 0.0)
        for straight in (True, False):
            _add(seen, straight, some, spectra, list(zip(plans, parts, strict=True)), onto, tally)
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
        if settings.block >= 0.5 * kernels.STEP * angstrom and abs(slope) <= _STEEPEST:
            tile = kernels.STEP * max(round(settings.block / angstrom / kernels.STEP), 1)
        step = 1.0 / (order.trace.last - order.trace.first)
        t = (order.first - order.trace.first) * step, step
        return cls(order, angstrom, tile, images.shares(order.wavelength, psf.planes.wavelength), t)


@dataclass(frozen=True, slots=True)
class Sizes:
    """How large stamps are.

    row   : float64[s] fraction of a point's light in a row at the edge of each of SIZES
    """

    row: Float
    limit: float
    least: int

    @classmethod
    def of(cls, psf: Psf, noise: float, settings: Settings) -> Sizes:
        """Of points; limit : electrons of a row that are not seen."""
        reach = len(psf.surface) - 1
        x = np.arange(-reach, reach + 1)
        row = [psf.surface[np.rint(np.hypot(x, size / 2)).astype(int).clip(0, reach)].sum() for size in SIZES]
        return cls(np.array(row), settings.edge * noise, settings.least)

    def size(self, peak: Float, wider: Float) -> Int:
        """[k] For spectra of so many electrons a column at most; wider : pixels, of galaxies."""
        dark = self.row * peak[:, None] < self.limit
        own = SIZES[np.where(dark.any(axis=1), dark.argmax(axis=1), len(SIZES) - 1)]
        wanted = np.maximum(own, self.least) + wider
        return np.asarray(SIZES[np.minimum(np.searchsorted(SIZES, wanted), len(SIZES) - 1)])


@dataclass(frozen=True, slots=True)
class _Part:
    """One order of some of the sources, [k] each.

    along, across : float64[k, i] polynomials of their traces
    sizes    : of their stamps, 0 = nothing of it is drawn;  straight : whether the trace is
    expected : electrons, on the frame and beside it;  peak : in the brightest column
    """

    along: Float
    across: Float
    sizes: Int
    straight: Bool
    expected: Float
    peak: Float

    @classmethod
    def of(cls, seen: _Seen, some: Int, spectra: Float32, plan: _Plan, shape: tuple[int, int]) -> _Part:
        order, (ny, nx), count = plan.order, shape, len(some)
        column, row = seen.sources.column[some], seen.sources.row[some]
        peak, expected = np.empty(count), np.empty(count)
        window = max(round(plan.angstrom), 1)
        kernels.brightest(spectra, seen.sources.electrons[some], order.response, window, peak, expected)
        place = np.stack([np.ones(count), column, row])
        along, across = (sums.product(part, place).T for part in (order.trace.x, order.trace.y))
        t = plan.t[0] + plan.t[1] * np.linspace(0.0, len(order.response) - 1.0, _PLACES)
        x, y = (np.polynomial.polynomial.polyval(t, part.T) for part in (along, across))
        limit = seen.sizes.limit * (1.0 if order.trace.order == 1 else seen.settings.faint / seen.settings.edge)
        sizes = seen.sizes.size(peak, seen.wider[some])
        left, right = column + x.min(axis=1), column + x.max(axis=1)
        low, high = row + y.min(axis=1), row + y.max(axis=1)
        beside = (right + sizes < 0) | (left - sizes > nx) | (high + sizes < 0) | (low - sizes > ny)
        across_step, along_step = np.diff(y, axis=1), np.diff(x, axis=1)
        straight = (np.abs(across_step - seen.slope * along_step) <= _STRAIGHT * np.abs(along_step)).all(axis=1)
        straight &= (along_step > 0.0).all(axis=1) | (along_step < 0.0).all(axis=1)
        nothing = beside | (peak < limit) | (peak <= 0.0)
        return cls(
            np.ascontiguousarray(along), np.ascontiguousarray(across), np.where(nothing, 0, sizes),
            straight & (plan.tile > 0), expected, peak,
        )  # fmt: skip


class _Seen:
    """Sources through the PSF."""

    def __init__(
        self, sources: Sources, psf: Psf, sizes: Sizes, settings: Settings, slope: float, shape: tuple[int, int]
    ) -> None:
        self.sources, self.psf, self.sizes, self.settings, self.slope = sources, psf, sizes, settings, slope
        body = sources.shape >= 0
        self.places = list(zip(sources.column.tolist(), sources.row.tolist(), strict=True))
        self.wider = np.zeros(len(sources))
        shapes = sources.shapes.take(sources.shape[body])
        self.wider[body] = _EXTENT * galaxy_shapes.half_light(shapes) / psf.pixel_scale
        pictured = (sources.picture_of(i) for i in range(len(sources)))
        self.wider += [0.0 if picture is None else picture.diagonal / psf.pixel_scale for picture in pictured]
        self.wider += sources.length
        self.bodies = {straight: images.bodies(sources, slope if straight else 0.0) for straight in (True, False)}
        assert psf.planes is not None
        count = len(psf.planes.wavelength)
        # How the PSF changes is known on the detector alone.
        column, row = np.clip(sources.column, 0.0, shape[1] - 1.0), np.clip(sources.row, 0.0, shape[0] - 1.0)
        one = [transfer.basis_weights(psf, np.tile(part, (len(sources), 1)), column, row) for part in np.eye(count)]
        self.weights = np.stack(one, axis=1)
        self._planes: dict[tuple[int, bool], Planes] = {}

    def images(self, some: Int, size: int, straight: bool) -> Float32:
        """Coefficients [m, b, n along, n across] of sources on stamps of `size` pixels."""
        key = size, straight
        if key not in self._planes:
            sampling = Sampling(size, self.settings.along, self.settings.across, self.slope, straight)
            self._planes[key] = images.planes(self.psf, sampling)
        own = self._planes[key]
        over = [images.spread_over(own, self.sources, i) for i in some.tolist()]
        return images.coefficients(own, self.weights[some], self.bodies[straight].take(some), over)

    def together(self, size: int) -> int:
        """How many stamps of `size` pixels are held at a time."""
        samples = self.weights.shape[1] * size**2 * self.settings.along * self.settings.across
        return max(int(_HELD // samples), 1)


def _add(
    seen: _Seen, straight: bool, some: Int, spectra: Float32, orders: list[tuple[_Plan, _Part]], onto: list[Int],
    tally: Tally,
) -> None:  # fmt: skip
    """Orders of some of the sources onto their frames: those that are straight, or the others."""
    sizes = np.stack([np.where(part.straight == straight, part.sizes, 0) for _, part in orders])
    # Orders that want stamps of nearly one size share the largest.
    largest = sizes.max(axis=0)
    sizes = np.where((sizes > 0) & (sizes >= _SHARED * largest), largest, sizes)
    tally.sizes[some] = np.maximum(tally.sizes[some], largest)
    shape = seen.settings.along, seen.settings.across
    for size in np.unique(sizes[sizes > 0]).tolist():
        which, count = np.flatnonzero((sizes == size).any(axis=0)), seen.together(size)
        for own in np.split(which, range(count, len(which), count)):
            for k, image in zip(own.tolist(), seen.images(some[own], size, straight), strict=True):
                i = int(some[k])
                factor, place = float(seen.sources.electrons[i]), seen.places[i]
                for m in np.flatnonzero(sizes[:, k] == size).tolist():
                    plan, part = orders[m]
                    tally.electrons[i, m] = kernels.spread(
                        image, spectra[k], factor, plan.order.response, plan.share, part.along[k], part.across[k],
                        plan.t, place, seen.slope, (size, *shape), plan.tile if straight else 0, FIXED_POINT, onto[m],
                    )  # fmt: skip
