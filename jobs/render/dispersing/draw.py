"""Drawing spectra: every source's light, spread along the traces of a grism's orders, summed onto a frame.

Order             a trace, and what it detects of a photon
Settings          what decides how much of a spectrum is drawn
draw              sources -> frame;  Tally : with what each brought, by order
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from jobs.render.dispersing import images, kernels
from jobs.render.dispersing.images import Planes, Sampling
from jobs.render.dispersing.traces import Trace
from jobs.render.drawing import transfer
from jobs.render.drawing.kernels.frame import FIXED_POINT
from jobs.render.psf.model import Psf
from jobs.render.sources import galaxy_shapes
from jobs.render.sources.source_list import Sources
from lake_schema.arrays import Float, Float32, Int

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
    """

    edge: float = 0.003
    faint: float = 0.01
    least: int = 24
    along: int = 2
    across: int = 3
    block: float = 110.0


@dataclass(frozen=True, slots=True)
class Tally:
    """electrons : float64[n, orders] of each source's orders that fell onto the frame, filled by `draw`."""

    electrons: Float


Spectra = Callable[[Int], Float32]


def draw(
    sources: Sources, spectra: Spectra, orders: Sequence[Order], psf: Psf, shape: tuple[int, int], noise: float,
    settings: Settings, tally: Tally | None = None,
) -> Float:  # fmt: skip
    """Expected electrons of the sources alone, float64[ny, nx].

    sources : places of their undispersed images, pixels, and their shapes
    spectra : of some of the sources, float32[n, w] at the wavelengths of the orders
    orders  : of one grism, with the same wavelengths;  psf : its wavelengths are the nodes
    shape   : ny, nx;  noise : of a pixel, e-;  tally : to be filled
    """
    frame = np.zeros(shape, np.int64)
    slope = _slope(orders[0].trace)
    seen = _Seen(sources, psf, Sizes.of(psf, noise, settings), settings, slope)
    plans = [_Plan.of(order, psf, settings, slope) for order in orders]
    for start in range(0, len(sources), _TOGETHER):
        some = np.arange(start, min(start + _TOGETHER, len(sources)))
        for i, spectrum in zip(some.tolist(), spectra(some), strict=True):
            fallen = [_add(seen, i, spectrum, plan, frame) for plan in plans]
            if tally is not None:
                tally.electrons[i] = fallen
    return frame / FIXED_POINT


def _slope(trace: Trace) -> float:
    """Rows a column along the first order, at the middle of the detector: of all orders, but for their curvature."""
    along, across = trace.polynomials(0.0, 0.0)
    return float(across[1:].sum() / along[1:].sum())


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
        return int(SIZES[min(np.searchsorted(SIZES, wanted), len(SIZES) - 1)])


class _Seen:
    """Sources through the PSF: images of one are kept until the next is drawn."""

    def __init__(self, sources: Sources, psf: Psf, sizes: Sizes, settings: Settings, slope: float) -> None:
        body = sources.shape >= 0
        self.sources, self.psf, self.sizes, self.settings, self.slope = sources, psf, sizes, settings, slope
        self.shapes = sources.shapes.take(sources.shape[body])
        self.form = galaxy_shapes.forms(self.shapes, sources.jacobian[body])
        self.row = np.where(body, np.cumsum(body) - 1, -1)
        self.wider = np.zeros(len(sources))
        self.wider[body] = _EXTENT * galaxy_shapes.half_light(self.shapes) / psf.pixel_scale
        count = len(psf.planes.wavelength)
        one = [
            transfer.basis_weights(psf, np.tile(part, (len(sources), 1)), sources.column, sources.row)
            for part in np.eye(count)
        ]
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
        found = images.coefficients(self._planes[size], self.weights[i], self.shapes, self.form, int(self.row[i]))
        self._last = i, size, found
        return size, found


def _add(seen: _Seen, i: int, spectrum: Float32, plan: _Plan, frame: Int) -> float:
    """One order of source i onto the frame; returns its electrons there."""
    order, settings, (ny, nx) = plan.order, seen.settings, frame.shape
    column, row = float(seen.sources.column[i]), float(seen.sources.row[i])
    electrons = np.empty(len(order.response))
    peak = kernels.electrons_of(
        spectrum, order.response, float(seen.sources.electrons[i]), max(round(plan.angstrom), 1), electrons
    )
    if peak < seen.sizes.limit * (1.0 if order.trace.order == 1 else settings.faint / settings.edge):
        return 0.0
    along, across = order.trace.polynomials(column, row)
    t = plan.t[0] + plan.t[1] * np.linspace(0.0, len(electrons) - 1.0, 33)
    x, y = (np.polynomial.polynomial.polyval(t, part) for part in (along, across))
    size = seen.sizes.size(peak, seen.wider[i])
    left, right, low, high = column + x.min(), column + x.max(), row + y.min(), row + y.max()
    if right + size < 0 or left - size > nx or high + size < 0 or low - size > ny:
        return 0.0
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
        return 0.0
    out = np.zeros((height, width), np.float32)
    kernels.disperse(coefficients, laid, first, rows, (size, samples, settings.across), plan.block, corner, out)
    return float(kernels.add(out, corner, FIXED_POINT, frame))
