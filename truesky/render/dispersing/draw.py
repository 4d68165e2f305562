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
from truesky.render.dispersing import images, kernels, large_galaxies, spreading
from truesky.render.dispersing.images import Planes, Sampling
from truesky.render.dispersing.stamp_sizes import LARGE_GALAXY_SIZES, Sizes
from truesky.render.drawing import stamps, transfer
from truesky.render.drawing.kernels.frame import FIXED_POINT
from truesky.render.psf.model import Psf
from truesky.render.sources.source_list import Sources
from truesky.request.accuracy import Accuracy

# Sources whose spectra are held at a time, and samples of their images.
_BATCH_SOURCES, _BATCH_SAMPLES = 256, 1 << 17
# Places at which it is seen where a trace goes, and whether it is straight: its slope, rows a column, is nowhere
# farther from that of all. Of wings as r^-3, moved by a first derivative, that leaves 6 times its square: 0.5 %.
_PLACES, _STRAIGHT = 33, 0.03
# Rows a column up to which images are sheared: they ring by 7e-5 of their peak at 4 deg, 2e-4 at 8, 2e-3 at 30.
_STEEPEST = 0.15
# Of the largest stamp, that an order must want to be drawn on it, too.
_SHARED_FRACTION = 0.6


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
    min_size: int = 24
    along: int = 2
    across: int = 3
    block: float = 110.0
    nodes: int = 4
    positions: int = 9


# What it is for, of a pixel's noise, and as measured by benchmarks/_dispersion.py.
TABLE = Path(__file__).with_name("settings.csv")


@cache
def settings_for(requested: Accuracy) -> Settings:
    """The cheapest settings that are for an accuracy, else the best."""
    table = read_settings()
    return settings_from_row(next((row for row in table if row["allowed"] <= requested.background), table[-1]))


def read_settings() -> list[dict[str, float]]:
    """The table of settings, the cheapest first."""
    with TABLE.open(newline="", encoding="utf-8") as lines:
        read = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    settings_rows = [{name: float(value) for name, value in row.items()} for row in read]
    return sorted(settings_rows, key=lambda row: -row["allowed"])


def settings_from_row(row: dict[str, float]) -> Settings:
    """Of a row of the table."""
    values: dict[str, Any] = {name: row[name] for name in ("edge", "faint", "block")}
    values |= {name: int(row[name]) for name in ("min_size", "along", "across", "nodes", "positions")}
    return Settings(**values)


Spectra = Callable[[Int], Float32]
# Of a PSF, by how stamps are sampled.
PlanesCache = dict[Sampling, Planes]


@dataclass(frozen=True, slots=True)
class DispersedSources:
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
    def empty(cls, sources: int, orders: int) -> Tally:
        """Of so many sources and orders, before anything is drawn."""
        shape = sources, orders
        return cls(np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(sources, np.int64))

    def add(self, pieces: Tally, parent: Int) -> None:
        """Of pieces [p] of sources `whole` [p]."""
        np.add.at(self.electrons, parent, pieces.electrons)
        np.add.at(self.expected, parent, pieces.expected)
        np.add.at(self.peak, parent, pieces.peak)
        np.maximum.at(self.sizes, parent, pieces.sizes)


def draw(
    sources: Sources, dispersed: DispersedSources, psf: Psf, shape: tuple[int, int], noise: float,
    tally: Tally | None = None, layers: dict[int, Float] | None = None, planes_cache: PlanesCache | None = None,
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
    order_frames = frames if layers is not None else frames * len(orders)
    slope = _slope(next((order for order in orders if order.trace.order == 1), orders[0]).trace)
    # What moves far is drawn in pieces, each with a part of the light.
    pieces, trail, parent = stamps.split_into_pieces(sources)
    pieces = pieces if sources.trail is None else replace(pieces, trail=trail)
    sizes = Sizes.from_sources(pieces, psf, settings.edge * noise, settings.min_size)
    plans = [_OrderPlan.from_order(order, psf, settings, slope) for order in orders]
    # Orders share images: where one of them is straight, in the coordinates in which it is a row.
    straight = any(plan.tile > 0 for plan in plans)
    source_images = _SourceImages(
        pieces, psf, sizes, settings, (slope, straight), shape, {} if planes_cache is None else planes_cache
    )
    piece_tally = Tally.empty(len(pieces), len(orders))
    for start in range(0, len(pieces), _BATCH_SOURCES):
        batch = np.arange(start, min(start + _BATCH_SOURCES, len(pieces)))
        spectra = dispersed.spectra(parent[batch])
        order_batches = [_OrderBatch.from_spectra(source_images, batch, spectra, plan, shape) for plan in plans]
        for column, part in enumerate(order_batches):
            piece_tally.expected[batch, column] = part.expected
            piece_tally.peak[batch, column] = np.where(part.sizes > 0, part.peak, 0.0)
        _add_orders(
            source_images, batch, spectra, list(zip(plans, order_batches, strict=True)), order_frames, piece_tally
        )
    if tally is not None:
        tally.add(piece_tally, parent)
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
class _OrderPlan:
    """What of an order is the same for all sources.

    angstrom : of a pixel along the trace;  tile : pixels that share a PSF, where it is straight; 0 = it never is
    share    : float64[w, b] of the PSF's wavelengths
    t        : of the first wavelength, and from one to the next
    """

    order: Order
    angstrom_per_pixel: float
    tile: int
    share: Float
    t: tuple[float, float]

    @classmethod
    def from_order(cls, order: Order, psf: Psf, settings: Settings, slope: float) -> _OrderPlan:
        assert psf.planes is not None
        along, _ = order.trace.polynomials(0.0, 0.0)
        length = max(abs(float(along[1:].sum())), 1e-6) * float(np.hypot(1.0, slope))
        angstrom_per_pixel = (order.trace.last - order.trace.first) / length
        tile = 0
        if settings.block >= 0.5 * spreading.STEP * angstrom_per_pixel and abs(slope) <= _STEEPEST:
            tile = spreading.STEP * max(round(settings.block / angstrom_per_pixel / spreading.STEP), 1)
        step = 1.0 / (order.trace.last - order.trace.first)
        t = (order.first - order.trace.first) * step, step
        return cls(order, angstrom_per_pixel, tile, images.shares(order.wavelength, psf.planes.wavelength), t)


@dataclass(frozen=True, slots=True)
class _OrderBatch:
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
    def from_spectra(
        cls, source_images: _SourceImages, batch: Int, spectra: Float32, plan: _OrderPlan, shape: tuple[int, int]
    ) -> _OrderBatch:
        order, (ny, nx), count = plan.order, shape, len(batch)
        column, row = source_images.sources.column[batch], source_images.sources.row[batch]
        peak, expected = np.empty(count), np.empty(count)
        window = max(round(plan.angstrom_per_pixel), 1)
        kernels.measure_peak_and_total(
            spectra, source_images.sources.electrons[batch], order.response, window, peak, expected
        )
        along, across = (part.T for part in order.trace.polynomials(column, row))
        t = plan.t[0] + plan.t[1] * np.linspace(0.0, len(order.response) - 1.0, _PLACES)
        x, y = (np.polynomial.polynomial.polyval(t, part.T) for part in (along, across))
        limit = source_images.sizes.limit * (
            1.0 if order.trace.order == 1 else source_images.settings.faint / source_images.settings.edge
        )
        sizes = source_images.sizes.size(batch, peak, expected)
        left_edge, right_edge = column + x.min(axis=1), column + x.max(axis=1)
        low_edge, high_edge = row + y.min(axis=1), row + y.max(axis=1)
        off_frame = (
            (right_edge + sizes < 0) | (left_edge - sizes > nx) | (high_edge + sizes < 0) | (low_edge - sizes > ny)
        )
        across_step, along_step = np.diff(y, axis=1), np.diff(x, axis=1)
        straight = (np.abs(across_step - source_images.slope * along_step) <= _STRAIGHT * np.abs(along_step)).all(
            axis=1
        )
        straight &= (along_step > 0.0).all(axis=1) | (along_step < 0.0).all(axis=1)
        not_drawn = off_frame | (peak < limit) | (peak <= 0.0)
        return cls(
            np.ascontiguousarray(along), np.ascontiguousarray(across), np.where(not_drawn, 0, sizes),
            np.where(straight, plan.tile, 0), expected, peak,
        )  # fmt: skip


class _SourceImages:
    """Sources through the PSF."""

    def __init__(
        self, sources: Sources, psf: Psf, sizes: Sizes, settings: Settings, slope: tuple[float, bool],
        shape: tuple[int, int], planes_cache: PlanesCache,
    ) -> None:  # fmt: skip
        self.sources, self.psf, self.sizes, self.settings = sources, psf, sizes, settings
        self.slope, self.straight = slope
        self.places = list(zip(sources.column.tolist(), sources.row.tolist(), strict=True))
        self.profiles = images.source_profiles(sources, self.slope if self.straight else 0.0)
        assert psf.planes is not None
        count = len(psf.planes.wavelength)
        # How the PSF changes is known on the detector alone.
        column, row = np.clip(sources.column, 0.0, shape[1] - 1.0), np.clip(sources.row, 0.0, shape[0] - 1.0)
        node_weights = [
            transfer.basis_weights(psf, np.tile(part, (len(sources), 1)), column, row) for part in np.eye(count)
        ]
        self.weights = np.stack(node_weights, axis=1)
        self._planes = planes_cache

    def stamp_sampling(self, size: int, smooth: bool = False) -> Sampling:
        """Of stamps of `size` pixels; smooth : of what giants.add draws."""
        template = Sampling(size, self.settings.along, self.settings.across, self.slope, self.straight)
        return large_galaxies.stamp_sampling(size, template, smooth)

    def images(self, batch: Int, sampling: Sampling) -> Float32:
        """Coefficients [m, b, n along, n across] of sources on stamps."""
        if sampling not in self._planes:
            self._planes[sampling] = images.planes(self.psf, sampling)
        stamp_planes = self._planes[sampling]
        transforms = [images.spread_transform(stamp_planes, self.sources, i) for i in batch.tolist()]
        return images.coefficients(stamp_planes, self.weights[batch], self.profiles.take(batch), transforms)

    def batch_size(self, sampling: Sampling) -> int:
        """How many stamps are held at a time."""
        samples = self.weights.shape[1] * sampling.n**2 * sampling.along * sampling.across
        return max(int(_BATCH_SAMPLES // samples), 1)


def _add_orders(
    source_images: _SourceImages,
    batch: Int,
    spectra: Float32,
    orders: list[tuple[_OrderPlan, _OrderBatch]],
    order_frames: list[Int],
    tally: Tally,
) -> None:
    """Orders of some of the sources onto their frames."""
    sizes = np.stack([part.sizes for _, part in orders])
    # Orders that want stamps of nearly one size share the largest.
    largest = sizes.max(axis=0)
    sizes = np.where((sizes > 0) & (sizes >= _SHARED_FRACTION * largest), largest, sizes)
    tally.sizes[batch] = np.maximum(tally.sizes[batch], largest)
    for size in np.unique(sizes[sizes > 0]).tolist():
        sampling = source_images.stamp_sampling(size)
        smooth = source_images.stamp_sampling(size, smooth=True) if size >= LARGE_GALAXY_SIZES[0] else None
        indices, count = np.flatnonzero((sizes == size).any(axis=0)), source_images.batch_size(sampling)
        for chunk in np.split(indices, range(count, len(indices), count)):
            for k, image in zip(chunk.tolist(), source_images.images(batch[chunk], sampling), strict=True):
                i = int(batch[k])
                smooth_image = None if smooth is None else source_images.images(batch[k : k + 1], smooth)[0]
                for m in np.flatnonzero(sizes[:, k] == size).tolist():
                    plan, part = orders[m]
                    light = spectra[k], float(source_images.sources.electrons[i]), plan.order.response
                    path, place = (part.along[k], part.across[k]), source_images.places[i]
                    fallen = spreading.spread(
                        image, *light, plan.share, *path, plan.t, place, *sampling.rows, sampling.shape,
                        int(part.tiles[k]), FIXED_POINT, order_frames[m],
                    )  # fmt: skip
                    if smooth is not None and smooth_image is not None:
                        fallen += large_galaxies.add(
                            smooth_image, light, plan.share, path, plan.t, place, smooth, order_frames[m]
                        )
                    tally.electrons[i, m] = fallen
