"""Draw slitless spectra: the light of sources, spread along the traces of a grism's orders and summed onto a frame.

A galaxy that exceeds the largest stamp is drawn in two parts (large_galaxies.py). A trail is drawn in pieces, each on a
separate stamp.
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

# Number of sources whose spectra are in memory at a time, and number of samples of their images.
_BATCH_SOURCES, _BATCH_SAMPLES = 256, 1 << 17
# Number of positions at which a trace is sampled. A trace counts as straight if its slope (rows per column) deviates
# from the common slope by at most the second value. Wings that fall as r^-3 and are moved by a first derivative then
# have a relative error of 6 times its square, 0.5 %.
_PLACES, _STRAIGHT = 33, 0.03
# Largest slope, in rows per column, for sheared images. They ring by 7e-5 of their peak at 4 deg, by 2e-4 at 8 deg and
# by 2e-3 at 30 deg.
_STEEPEST = 0.15
# An order is drawn on the largest stamp of its source if its stamp has at least this fraction of that side.
_SHARED_FRACTION = 0.6


@dataclass(frozen=True, slots=True)
class Order:
    """Trace and response of a grism order.

    Attributes
    ----------
    trace : Trace
        Trace of the order.
    first : int
        Wavelength of the first element of the response, Angstrom.
    response : float array, shape (w,)
        Electrons per unit of the spectrum, in steps of 1 Angstrom. Negative values subtract electrons.
    """

    trace: Trace
    first: int
    response: Float

    @property
    def wavelength(self) -> Float:
        """Wavelengths [w] of the response, Angstrom."""
        return self.first + np.arange(float(len(self.response)))


@dataclass(frozen=True, slots=True)
class Settings:
    """Limits for neglected light of a spectrum, and sampling of its image.

    Attributes
    ----------
    edge : float
        Largest light in a row at the edge of a stamp, as a fraction of the pixel noise.
    faint : float
        An order is not drawn if the light of its brightest column is below this fraction of the pixel noise; `edge` is
        the limit for the first order.
    min_size : int
        Smallest side of a stamp, pixels.
    along, across : int
        Samples per pixel of a stamp, along and across the trace.
    block : float
        Range of wavelengths with a common PSF, Angstrom. With 0, each wavelength has its PSF and its rows, which is
        slow.
    nodes : int
        Number of wavelengths at which the PSF is computed.
    positions : int
        Number of PSF positions on a detector, one of `euclid.DEGREES`.
    """

    edge: float = 0.003
    faint: float = 0.01
    min_size: int = 24
    along: int = 2
    across: int = 3
    block: float = 110.0
    nodes: int = 4
    positions: int = 9


# Settings with the allowed background error (fractions of the pixel noise), measured by benchmarks/_dispersion.py.
TABLE = Path(__file__).with_name("settings.csv")


@cache
def settings_for(requested: Accuracy) -> Settings:
    """Return the fastest settings for an accuracy, or the most accurate ones if no settings are sufficient."""
    table = read_settings()
    return settings_from_row(next((row for row in table if row["allowed"] <= requested.background), table[-1]))


def read_settings() -> list[dict[str, float]]:
    """Read the table of settings, sorted from the fastest to the most accurate."""
    with TABLE.open(newline="", encoding="utf-8") as lines:
        read = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    settings_rows = [{name: float(value) for name, value in row.items()} for row in read]
    return sorted(settings_rows, key=lambda row: -row["allowed"])


def settings_from_row(row: dict[str, float]) -> Settings:
    """Return the settings in a row of the table."""
    values: dict[str, Any] = {name: row[name] for name in ("edge", "faint", "block")}
    values |= {name: int(row[name]) for name in ("min_size", "along", "across", "nodes", "positions")}
    return Settings(**values)


Spectra = Callable[[Int], Float32]
# Planes of a PSF by the sampling of stamps.
PlanesCache = dict[Sampling, Planes]


@dataclass(frozen=True, slots=True)
class DispersedSources:
    """Spectra of sources, orders of a grism, and settings.

    Attributes
    ----------
    spectra : callable
        (indices of n sources) -> float32[n, w] spectra at the wavelengths of the orders.
    orders : tuple of Order
        Orders of one grism, with the same wavelengths.
    settings : Settings
        Settings of drawing.
    """

    spectra: Spectra
    orders: tuple[Order, ...]
    settings: Settings


@dataclass(frozen=True, slots=True)
class Tally:
    """Light of each source by order, filled by `draw`.

    Attributes
    ----------
    electrons : float array, shape (n, orders)
        Electrons on the frame.
    expected : float array, shape (n, orders)
        Electrons on and outside the frame.
    peak : float array, shape (n, orders)
        Electrons of the brightest column, 0 if the order is not drawn.
    sizes : int array, shape (n,)
        Side of the largest stamp, pixels; 0 if nothing was drawn.
    """

    electrons: Float
    expected: Float
    peak: Float
    sizes: Int

    @classmethod
    def empty(cls, sources: int, orders: int) -> Tally:
        """Return a tally of zeros for given numbers of sources and orders."""
        shape = sources, orders
        return cls(np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(sources, np.int64))

    def add(self, pieces: Tally, parent: Int) -> None:
        """Add the tally of pieces [p] to that of their sources `parent` [p]."""
        np.add.at(self.electrons, parent, pieces.electrons)
        np.add.at(self.expected, parent, pieces.expected)
        np.add.at(self.peak, parent, pieces.peak)
        np.maximum.at(self.sizes, parent, pieces.sizes)


def draw(
    sources: Sources, dispersed: DispersedSources, psf: Psf, shape: tuple[int, int], noise: float,
    tally: Tally | None = None, layers: dict[int, Float] | None = None, planes_cache: PlanesCache | None = None,
) -> Float:  # fmt: skip
    """Draw the expected electrons of dispersed sources, without sky.

    Parameters
    ----------
    sources : Sources
        Positions of the undispersed images, pixels, and shapes.
    dispersed : DispersedSources
        Spectra of the sources and orders of the grism.
    psf : Psf
        PSF of the detector; its wavelengths are the nodes.
    shape : (int, int)
        Rows and columns of the frame.
    noise : float
        Noise per pixel, electrons.
    tally : Tally, optional
        Filled with the light of each source.
    layers : dict, optional
        Filled with the frame of each order, whose sum is the result; None to draw all orders on one frame.
    planes_cache : PlanesCache, optional
        Planes that calls with the same PSF and orders share; filled when needed.

    Returns
    -------
    float array, shape (ny, nx)
        Electrons.
    """
    frames = [np.zeros(shape, np.int64)]
    orders, settings = dispersed.orders, dispersed.settings
    if layers is not None:
        frames += [np.zeros(shape, np.int64) for _ in orders[1:]]
    order_frames = frames if layers is not None else frames * len(orders)
    slope = _slope(next((order for order in orders if order.trace.order == 1), orders[0]).trace)
    # Long trails are drawn in pieces, each with a part of the light.
    pieces, trail, parent = stamps.split_into_pieces(sources)
    pieces = pieces if sources.trail is None else replace(pieces, trail=trail)
    sizes = Sizes.from_sources(pieces, psf, settings.edge * noise, settings.min_size)
    plans = [_OrderPlan.from_order(order, psf, settings, slope) for order in orders]
    # Orders share images. If one of the orders is straight, these have the coordinates in which it is a row.
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
    # The sum of integers does not depend on whether the orders have separate frames.
    return sum(frames[1:], frames[0]) / FIXED_POINT


def _slope(trace: Trace) -> float:
    """Slope of the first order at the middle of the detector, rows per column; 0 if it is not along the columns.

    Apart from their curvature, all orders have this slope.
    """
    along, across = (float(part[1:].sum()) for part in trace.polynomials(0.0, 0.0))
    return across / along if abs(along) > abs(across) else 0.0


@dataclass(frozen=True, slots=True)
class _OrderPlan:
    """Properties of an order that are the same for all sources.

    Attributes
    ----------
    order : Order
        The order.
    angstrom_per_pixel : float
        Dispersion along the trace.
    tile : int
        Pixels along a straight trace with a common PSF; 0 if no trace of this order is straight.
    share : float array, shape (w, b)
        Shares of the PSF's wavelengths.
    t : (float, float)
        Trace parameter t of the first wavelength, and its step.
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
    """One order of k sources.

    Attributes
    ----------
    along, across : float array, shape (k, i)
        Polynomials of the traces for columns and rows.
    sizes : int array, shape (k,)
        Sides of the stamps, pixels; 0 if the order is not drawn.
    tiles : int array, shape (k,)
        Pixels with a common PSF; 0 if the trace is not straight.
    expected : float array, shape (k,)
        Electrons on and outside the frame.
    peak : float array, shape (k,)
        Electrons of the brightest column.
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
    """Images of sources through the PSF."""

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
        # The variation of the PSF is defined only on the detector.
        column, row = np.clip(sources.column, 0.0, shape[1] - 1.0), np.clip(sources.row, 0.0, shape[0] - 1.0)
        node_weights = [
            transfer.basis_weights(psf, np.tile(part, (len(sources), 1)), column, row) for part in np.eye(count)
        ]
        self.weights = np.stack(node_weights, axis=1)
        self._planes = planes_cache

    def stamp_sampling(self, size: int, smooth: bool = False) -> Sampling:
        """Sampling of stamps of `size` pixels; `smooth` selects the part drawn by `large_galaxies.add`."""
        template = Sampling(size, self.settings.along, self.settings.across, self.slope, self.straight)
        return large_galaxies.stamp_sampling(size, template, smooth)

    def images(self, batch: Int, sampling: Sampling) -> Float32:
        """Spline coefficients [m, b, n along, n across] of sources on stamps."""
        if sampling not in self._planes:
            self._planes[sampling] = images.planes(self.psf, sampling)
        stamp_planes = self._planes[sampling]
        transforms = [images.spread_transform(stamp_planes, self.sources, i) for i in batch.tolist()]
        return images.coefficients(stamp_planes, self.weights[batch], self.profiles.take(batch), transforms)

    def batch_size(self, sampling: Sampling) -> int:
        """Number of stamps that are in memory at a time."""
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
    """Add the orders of a batch of sources to their frames."""
    sizes = np.stack([part.sizes for _, part in orders])
    # Orders with stamps of similar size share the largest.
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
