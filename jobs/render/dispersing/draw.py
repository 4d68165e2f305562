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

from jobs.accuracy import Accuracy
from jobs.render.camera.traces import Trace
from jobs.render.dispersing import images, kernels
from jobs.render.dispersing.images import Planes, Sampling
from jobs.render.drawing import arcs, transfer
from jobs.render.drawing.kernels.frame import FIXED_POINT
from jobs.render.psf.model import Psf
from jobs.render.sources import galaxy_shapes
from jobs.render.sources.source_list import Sources
from lake_schema.arrays import Array, Float, Float32, Int

# Sides of stamps whose transforms are fast.
SIZES = np.array([16, 20, 24, 28, 32, 36, 40, 48, 56, 64, 80, 96, 128, 160, 192, 256, 320, 384, 512])
# Sources whose spectra are held at a time.
_TOGETHER = 64
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
    block  : A of a spectrum that share one PSF
    nodes  : wavelengths that the PSF is computed at;  positions : places of it on a detector, one of euclid.DEGREES
    """

    edge: float = 0.003
    faint: float = 0.01
    least: int = 24
    along: int = 2
    across: int = 3
    block: float = 110.0
    nodes: int = 3
    positions: int = 9


_TABLE = Path(__file__).with_name("settings.csv")


@cache
def settings_for(wanted: Accuracy) -> Settings:
    """The cheapest settings that are for an accuracy, else the best."""
    with _TABLE.open(newline="", encoding="utf-8") as lines:
        rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    rows.sort(key=lambda row: -float(row["background"]))
    row = next((row for row in rows if float(row["background"]) <= wanted.background), rows[-1])
    known: dict[str, Any] = {name: float(row[name]) for name in ("edge", "faint", "block")}
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
    sizes     : int64[n] side of its largest stamp, pixels; 0 = none was drawn
    """

    electrons: Float
    expected: Float
    sizes: Int

    @classmethod
    def of(cls, sources: int, orders: int) -> Tally:
        """Of so many sources and orders, before anything is drawn."""
        shape = sources, orders
        return cls(np.zeros(shape), np.zeros(shape), np.zeros(sources, np.int64))


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
    slope = _slope(orders[0].trace)
    seen = _Seen(sources, psf, Sizes.of(psf, noise, settings), settings, slope, shape)
    plans = [_Plan.of(order, psf, settings, slope) for order in orders]
    if layers is not None:
        frames += [np.zeros(shape, np.int64) for _ in orders[1:]]
    onto = frames if layers is not None else frames * len(orders)
    for start in range(0, len(sources), _TOGETHER):
        some = np.arange(start, min(start + _TOGETHER, len(sources)))
        for i, spectrum in zip(some.tolist(), dispersed.spectra(some), strict=True):
            brought = [_add(seen, i, spectrum, plan, frame) for plan, frame in zip(plans, onto, strict=True)]
            if tally is not None:
                fallen, expected, sizes = zip(*brought, strict=True)
                tally.electrons[i], tally.expected[i], tally.sizes[i] = fallen, expected, max(sizes)
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

    angstrom : of a pixel along the trace;  block : samples that share a PSF
    share    : float64[w, b] of the PSF's wavelengths
    t        : of the first wavelength, and from one to the next
    """

    order: Order
    angstrom: float
    block: int
    share: Float
    t: tuple[float, float]

    @classmethod
    def of(cls, order: Order, psf: Psf, settings: Settings, slope: float) -> _Plan:
        assert psf.planes is not None
        along, _ = order.trace.polynomials(0.0, 0.0)
        length = max(abs(float(along[1:].sum())), 1e-6) * float(np.hypot(1.0, slope))
        angstrom = (order.trace.last - order.trace.first) / length
        block = max(round(settings.along * settings.block / angstrom), 1)
        step = 1.0 / (order.trace.last - order.trace.first)
        t = (order.first - order.trace.first) * step, step
        return cls(order, angstrom, block, images.shares(order.wavelength, psf.planes.wavelength), t)


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

    def size(self, peak: float, wider: float) -> int:
        """For a spectrum of so many electrons a column at most; wider : pixels, of a galaxy."""
        dark = np.flatnonzero(self.row * peak < self.limit)
        own = SIZES[dark[0]] if len(dark) else SIZES[-1]
        wanted = max(float(own), float(self.least)) + wider
        return int(SIZES[min(int(np.searchsorted(SIZES, wanted)), len(SIZES) - 1)])


class _Seen:
    """Sources through the PSF: images of one are kept until the next is drawn."""

    def __init__(
        self, sources: Sources, psf: Psf, sizes: Sizes, settings: Settings, slope: float, shape: tuple[int, int]
    ) -> None:
        body = sources.shape >= 0
        self.sources, self.psf, self.sizes, self.settings, self.slope = sources, psf, sizes, settings, slope
        self.shapes = sources.shapes.take(sources.shape[body])
        self.form = galaxy_shapes.forms(self.shapes, sources.jacobian[body])
        self.row = np.where(body, np.cumsum(body) - 1, -1)
        self.wider = np.zeros(len(sources))
        self.wider[body] = _EXTENT * galaxy_shapes.half_light(self.shapes) / psf.pixel_scale
        pictured = (sources.picture_of(i) for i in range(len(sources)))
        self.wider += [0.0 if picture is None else picture.diagonal / psf.pixel_scale for picture in pictured]
        self.wider += sources.length
        assert psf.planes is not None
        count = len(psf.planes.wavelength)
        # How the PSF changes is known on the detector alone.
        column, row = np.clip(sources.column, 0.0, shape[1] - 1.0), np.clip(sources.row, 0.0, shape[0] - 1.0)
        one = [transfer.basis_weights(psf, np.tile(part, (len(sources), 1)), column, row) for part in np.eye(count)]
        self.weights = np.stack(one, axis=1)
        self._planes: dict[int, Planes] = {}
        self._last: tuple[int, int, Float32] | None = None

    def images(self, i: int, size: int) -> tuple[int, Float32]:
        """(side, coefficients) of a stamp of at least `size` pixels."""
        if self._last is not None and self._last[0] == i and self._last[1] >= size:
            return self._last[1:]
        if size not in self._planes:
            sampling = Sampling(size, self.settings.along, self.settings.across, self.slope)
            self._planes[size] = images.planes(self.psf, sampling)
        some = self._planes[size]
        found = images.coefficients(
            some, self.weights[i], self.shapes, self.form, int(self.row[i]), self._spread(i, some)
        )
        self._last = i, size, found
        return size, found

    def _spread(self, i: int, some: Planes) -> Array | None:
        """[rows, columns] transform of a picture, or of a trail, over which a source's light is spread."""
        picture, trail = self.sources.picture_of(i), self.sources.trail
        kx, ky = np.meshgrid(some.kx, some.ky)
        if picture is not None:
            found = arcs.transform(picture, self.sources.jacobian[i], kx.ravel(), ky.ravel())
            return np.asarray(found.reshape(kx.shape).astype(np.complex64))
        if trail is not None and trail[i].any():
            return np.asarray(np.sinc((kx * trail[i, 0] + ky * trail[i, 1]) / (2 * np.pi)).astype(np.float32))
        return None


def _add(seen: _Seen, i: int, spectrum: Float32, plan: _Plan, frame: Int) -> tuple[float, float, int]:
    """One order of source i onto the frame: (electrons that fell there, all of them, side of its stamp or 0)."""
    order, settings, (ny, nx) = plan.order, seen.settings, frame.shape
    column, row = float(seen.sources.column[i]), float(seen.sources.row[i])
    electrons = np.empty(len(order.response))
    peak = kernels.electrons_of(
        spectrum, order.response, float(seen.sources.electrons[i]), max(round(plan.angstrom), 1), electrons
    )
    nothing = 0.0, float(electrons.sum()), 0
    if peak < seen.sizes.limit * (1.0 if order.trace.order == 1 else settings.faint / settings.edge):
        return nothing
    along, across = order.trace.polynomials(column, row)
    t = plan.t[0] + plan.t[1] * np.linspace(0.0, len(electrons) - 1.0, 33)
    x, y = (np.polynomial.polynomial.polyval(t, part) for part in (along, across))
    size = seen.sizes.size(peak, seen.wider[i])
    left, right, low, high = column + x.min(), column + x.max(), row + y.min(), row + y.max()
    if right + size < 0 or left - size > nx or high + size < 0 or low - size > ny:
        return nothing
    size, coefficients = seen.images(i, size)
    samples = settings.along
    first = int(np.floor(samples * left)) - 3
    laid = np.zeros((coefficients.shape[0], int(np.ceil(samples * right)) + 4 - first))
    kernels.lay(electrons, along, plan.t, column, samples, plan.share, first, laid)
    at = (first + np.arange(laid.shape[1])) / samples
    order_x = np.argsort(x)
    bent = np.interp(at - column, x[order_x], (y - seen.slope * x)[order_x])
    rows = row + seen.slope * (at - column) + bent
    corner = max(int(np.floor(left)) - size // 2 - 2, 0), max(int(np.floor(rows.min())) - size // 2 - 1, 0)
    width = min(int(np.ceil(right)) + size // 2 + 3, nx) - corner[0]
    height = min(int(np.ceil(rows.max())) + size // 2 + 2, ny) - corner[1]
    if width <= 0 or height <= 0:
        return nothing
    out = np.zeros((height, width), np.float32)
    kernels.disperse(coefficients, laid, first, rows, (size, samples, settings.across), plan.block, corner, out)
    return float(kernels.add(out, corner, FIXED_POINT, frame)), nothing[1], size
