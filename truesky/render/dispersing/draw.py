"""Draw slitless spectra: the light of sources, spread along the traces of a grism's orders on a detector.

The image of a source is computed on a stamp (square image around the source), and added at each position along the
trace. A galaxy that exceeds the largest stamp is drawn in two parts, a sharp and a smooth one (large_galaxies.py). The
trail of a moving source is drawn in pieces, each on a separate stamp.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from lake_schema.arrays import Bool, Float, Float32, Int
from truesky.render.camera.traces import Trace
from truesky.render.dispersing import images, kernels, large_galaxies, separable, spreading
from truesky.render.dispersing.images import Planes, Sampling
from truesky.render.dispersing.stamp_sizes import LARGE_GALAXY_SIZES, LARGEST, Sizes
from truesky.render.dispersing.wavelength_bins import Bins
from truesky.render.drawing import stamps, transfer
from truesky.render.drawing.kernels.frame import FIXED_POINT
from truesky.render.psf.model import Psf
from truesky.render.sources.source_list import Sources
from truesky.request.accuracy import Accuracy

# Number of sources whose spectra are in memory at a time.
_BATCH_SOURCES = 256
# Largest number of samples of source images, at all wavelengths of the PSF together, that are in memory at a time. A
# single image may be larger; it is then computed alone.
_BATCH_SAMPLES = 1 << 17
# Number of positions along a trace that are computed to test whether the trace is straight (see `_STRAIGHT`).
_PLACES = 33
# A trace counts as straight if its slope (rows per column) differs everywhere by at most this from the slope of the
# first order's trace. Larger differences require the slower method for curved traces. In a straight trace, the
# difference is corrected to first order by a derivative of the source's image. Wings that fall as r^-3 with the
# distance r from the source then have a relative error of 6 times the square of the difference, 0.5 %.
_STRAIGHT = 0.03
# Largest slope of a trace, rows per column, for which the images of sources are stored in sheared coordinates, in which
# the trace is a row. Steeper traces are drawn by the slower method for curved traces. The shear causes ringing in the
# images: 7e-5 of their peak for a trace inclined by 4 deg to the rows, 2e-4 for 8 deg and 2e-3 for 30 deg.
_STEEPEST = 0.15
# The spectral orders of a source need stamps of different sizes. If the side that an order needs is at least this
# fraction of the source's largest side, the order is drawn from the image on the largest stamp. The image of the source
# is then computed only once.
_SHARED_FRACTION = 0.6
# Factor by which upper limits of a source's electrons are increased, because of the rounding of spectra in single
# precision.
_ROUNDING = 1.001
# A faint order is drawn as a product of two profiles (separable.py) only if the slope of its trace differs from that of
# the images by at most this, in rows per column.
_SEPARABLE_SLOPE = 0.3
# Electrons that a source of unit brightness may have at a wavelength without a weight (see `DispersedSources.weights`).
_UNLIMITED = 1e30


@dataclass(frozen=True, slots=True)
class Order:
    """Trace and response of one spectral order of a grism.

    Attributes
    ----------
    trace : Trace
        Positions of the wavelengths on the detector relative to the undispersed image.
    first : int
        Wavelength of the first element of `response`, Angstrom.
    response : float array, shape (w,)
        Electrons in a bin of 1 Angstrom per unit of a source's spectrum, at wavelengths in steps of 1 Angstrom.
        Negative values subtract electrons.
    """

    trace: Trace
    first: int
    response: Float

    @property
    def wavelength(self) -> Float:
        """Wavelengths [w] of the elements of `response`, Angstrom."""
        return self.first + np.arange(float(len(self.response)))


@dataclass(frozen=True, slots=True)
class Settings:
    """Limits for the light that is neglected in a slitless spectrum, and sampling of the images of sources.

    Limits are fractions of the noise (rms) of a detector pixel.

    Attributes
    ----------
    edge : float
        Largest light of a spectrum that a pixel at the edge of its stamp (square image of the source) may have.
    faint : float
        A spectral order is not drawn if all light in its brightest column (sum over rows) is below this limit. For the
        first order, `edge` is used instead.
    min_size : int
        Smallest side of a stamp, pixels.
    along, across : int
        Samples of a source's image per detector pixel, along and across the trace.
    block : float
        Range of wavelengths along a straight trace that are drawn with the same PSF, Angstrom. If it is shorter than
        two pixels of the trace, as with 0, the PSF and the row of the trace are computed for each sample along the
        trace, which is slow.
    nodes : int
        Number of wavelengths at which the PSF is computed; it is interpolated between them.
    positions : int
        Number of positions on a detector at which the PSF is computed: 1, 4, 9 or 25 (keys of `euclid.DEGREES`).
    separable : float
        A spectral order is drawn as a product of a profile along and a profile across the trace (separable.py) if all
        light in its brightest column is below this limit. With 0 no order is.
    bin : float
        Distance, in pixels along the trace, of the wavelengths at which the light of a spectrum is summed before it is
        drawn (wavelength_bins.py). With 0 every wavelength is drawn. With 0.25 an emission line of a star, which is as
        narrow as the PSF allows, changes by less than 1e-3 of its peak.
    """

    edge: float = 0.003
    faint: float = 0.01
    min_size: int = 24
    along: int = 2
    across: int = 3
    block: float = 110.0
    nodes: int = 4
    positions: int = 9
    separable: float = 0.0
    bin: float = 0.25


# File with one row of settings (attributes of `Settings`) per accuracy. The column `allowed` is the allowed error of
# the background, as a fraction of the noise of a pixel, for which they are used. benchmarks/_dispersion.py measures the
# errors of bright spectra, which are larger.
TABLE = Path(__file__).with_name("settings.csv")


@cache
def settings_for(requested: Accuracy) -> Settings:
    """Return the fastest settings in settings.csv for an error of the background of at most `requested.background`.

    The error is a fraction of the noise of a pixel, for faint sources. If there are no settings for it, the most
    accurate ones are returned.
    """
    return settings_from_row(_row_for(requested))


def expected_errors(requested: Accuracy) -> dict[str, float]:
    """Return the measured errors of the settings for an accuracy, in spectra of 72 sources of H = 17 to 23.

    The settings were chosen with other sources. `flux` is the relative error of an emission line, `position` its error
    in pixels, and `background` the largest error of a pixel, as a fraction of its noise.
    """
    row = _row_for(requested)
    return {name: row[f"{name}_held"] for name in ("flux", "position", "background")}


def _row_for(requested: Accuracy) -> dict[str, float]:
    table = read_settings()
    return next((row for row in table if row["allowed"] <= requested.background), table[-1])


def read_settings() -> list[dict[str, float]]:
    """Return the rows of settings.csv as dictionaries by column name, from the fastest to the most accurate."""
    with TABLE.open(newline="", encoding="utf-8") as lines:
        read = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    settings_rows = [{name: float(value) for name, value in row.items()} for row in read]
    return sorted(settings_rows, key=lambda row: -row["allowed"])


def settings_from_row(row: dict[str, float]) -> Settings:
    """Return the settings in a row of `read_settings`. KeyError is raised if a column is missing."""
    values: dict[str, Any] = {name: row[name] for name in ("edge", "faint", "block", "separable")}
    values |= {name: int(row[name]) for name in ("min_size", "along", "across", "nodes", "positions")}
    return Settings(**values)


# Function that returns the spectra [n, w] of n sources at the w wavelengths of a grism's orders, from the indices [n]
# of these sources.
Spectra = Callable[[Int], Float32]
# Fourier transforms of the images of one PSF, by size and sampling of the stamps (square images of sources) for which
# they were computed.
PlanesCache = dict[Sampling, Planes]


@dataclass(frozen=True, slots=True)
class DispersedSources:
    """Spectra of sources, spectral orders of a grism, and limits for the light that is not drawn.

    Attributes
    ----------
    spectra : callable
        Function (indices of n sources) -> float32[n, w], their spectra at the wavelengths of the orders.
    orders : tuple of Order
        Orders of one grism; all must have the same w wavelengths.
    settings : Settings
        Limits for the light that is not drawn, and sampling of the images of sources.
    weights : float array, shape (w,), optional
        Weights of the wavelengths for which the sum of weights times spectrum is at most 1 for every source. No
        spectrum may be negative. The spectra of sources of which nothing can be drawn are then not computed. Without
        weights, all spectra are computed.
    """

    spectra: Spectra
    orders: tuple[Order, ...]
    settings: Settings
    weights: Float | None = None


@dataclass(frozen=True, slots=True)
class Tally:
    """Light of each of n sources in each spectral order, as an output of `draw`.

    Attributes
    ----------
    electrons : float array, shape (n, orders)
        Electrons that were drawn on the frame (image of the detector).
    expected : float array, shape (n, orders)
        Electrons of the whole order, on and outside the frame. If the response is negative, their absolute values are
        counted. 0 for sources whose spectra were not computed (see `DispersedSources.weights`).
    peak : float array, shape (n, orders)
        Electrons (absolute values) in the brightest column of the order, summed over its rows; 0 if the order was not
        drawn.
    sizes : int array, shape (n,)
        Side of the largest stamp (square image of the source) from which an order was drawn, pixels; 0 if none was.
    """

    electrons: Float
    expected: Float
    peak: Float
    sizes: Int

    @classmethod
    def empty(cls, sources: int, orders: int) -> Tally:
        """Return a tally of zeros for the given number of sources and of orders, to be filled by `draw`."""
        shape = sources, orders
        return cls(np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(sources, np.int64))

    def add(self, pieces: Tally, parent: Int) -> None:
        """Add the light of p pieces of sources to this tally, which has one entry per whole source.

        The trail of a moving source is drawn in several pieces. `parent` [p] is the index of the source to which each
        piece belongs. Electrons, in total and in the brightest column, are added. The largest side of a stamp is kept.
        """
        np.add.at(self.electrons, parent, pieces.electrons)
        np.add.at(self.expected, parent, pieces.expected)
        np.add.at(self.peak, parent, pieces.peak)
        np.maximum.at(self.sizes, parent, pieces.sizes)


def draw(
    sources: Sources, dispersed: DispersedSources, psf: Psf, shape: tuple[int, int], noise: float,
    tally: Tally | None = None, layers: dict[int, Float] | None = None, planes_cache: PlanesCache | None = None,
) -> Float:  # fmt: skip
    """Draw the expected electrons of slitless spectra on a detector, without sky and noise.

    Parameters
    ----------
    sources : Sources
        Sources with the positions of their undispersed images, pixels. Their attribute `electrons` is the factor by
        which the spectrum of each source is multiplied.
    dispersed : DispersedSources
        Spectra of the sources, and spectral orders of the grism.
    psf : Psf
        PSF of the detector, given by images at the wavelengths of `images.nodes`.
    shape : (int, int)
        Number of rows and of columns of the detector.
    noise : float
        Noise of a pixel, electrons rms. The limits in `dispersed.settings` are fractions of it.
    tally : Tally, optional
        Light of each source; this call adds to it.
    layers : dict, optional
        Filled with the image of each order (by number of the order), whose sum is the result. None to draw all orders
        on one image, which needs less memory.
    planes_cache : PlanesCache, optional
        Fourier transforms of the PSF. Several calls with the same PSF and orders can share them. Missing ones are
        added.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons, rounded to 1 / FIXED_POINT (1e-6 electrons) for each spectrum and pixel. The result does not
        depend on the order of the sources.
    """
    frames = [np.zeros(shape, np.int64)]
    orders, settings = dispersed.orders, dispersed.settings
    if layers is not None:
        frames += [np.zeros(shape, np.int64) for _ in orders[1:]]
    order_frames = frames if layers is not None else frames * len(orders)
    slope = _slope(next((order for order in orders if order.trace.order == 1), orders[0]).trace)
    # The trail of a moving source is split into pieces. Each piece has a part of the source's light, and is drawn like
    # a source on a separate stamp.
    pieces, trail, parent = stamps.split_into_pieces(sources)
    pieces = pieces if sources.trail is None else replace(pieces, trail=trail)
    sizes = Sizes.from_sources(pieces, psf, settings.edge * noise, settings.min_size)
    plans = [_OrderPlan.from_order(order, psf, settings, slope) for order in orders]
    # All spectral orders of a source are drawn from the same image. If any order may have straight traces, the image is
    # stored in sheared coordinates, in which straight traces are rows.
    straight = any(plan.tile > 0 for plan in plans)
    source_images = _SourceImages(
        pieces, psf, sizes, settings, (slope, straight), shape, {} if planes_cache is None else planes_cache
    )
    piece_tally = Tally.empty(len(pieces), len(orders))
    drawable = _find_drawable(source_images, parent, plans, dispersed.weights, shape)
    for start in range(0, len(drawable), _BATCH_SOURCES):
        batch = drawable[start : start + _BATCH_SOURCES]
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
    # Frames have integer pixels (FIXED_POINT per electron). Their sum is exact, so the result is the same whether each
    # order has its own frame or not.
    return sum(frames[1:], frames[0]) / FIXED_POINT


def _find_drawable(
    source_images: _SourceImages,
    parent: Int,
    plans: Sequence[_OrderPlan],
    weights: Float | None,
    shape: tuple[int, int],
) -> Int:
    """Return the indices of the sources of which some order may be drawn, without computing spectra.

    Parameters
    ----------
    source_images : _SourceImages
        Positions, electrons and stamps of the sources. A moving source is given in several pieces.
    parent : int array, shape (p,)
        Index of the whole source to which each of the p pieces belongs. If one piece may be drawn, all pieces of its
        source are returned, because the electrons of the whole source are counted.
    plans : sequence of _OrderPlan
        Spectral orders.
    weights : float array, shape (w,), or None
        Weights of `DispersedSources`. If None, all sources may be drawn.
    shape : (int, int)
        Number of rows and of columns of the detector.

    Returns
    -------
    int array
        Indices in ascending order.

    Notes
    -----
    The electrons of an order are at most those of a source whose light is all at the wavelength with the largest ratio
    of response and weight. A spectrum with more electrons has a larger stamp, so that a source whose largest possible
    spectrum is not drawn is certainly not drawn.
    """
    if weights is None:
        return np.arange(len(parent))
    everything, may_be_drawn = np.arange(len(parent)), np.zeros(len(parent), bool)
    electrons = source_images.sources.electrons
    for plan in plans:
        size = np.abs(plan.order.response)
        ratio = np.divide(size, weights, out=np.where(size > 0.0, _UNLIMITED, 0.0), where=weights > 0.0)
        largest = electrons * (_ROUNDING * ratio.max(initial=0.0))
        may_be_drawn |= source_images.sizes_on_frame(everything, plan, (largest, largest), shape)[0] > 0
    return np.flatnonzero(np.bincount(parent, may_be_drawn, parent.max(initial=-1) + 1)[parent] > 0)


def _slope(trace: Trace) -> float:
    """Return the slope of a trace for a source at the first pixel of the detector, in rows per column.

    It is 0 if the trace spans at least as many rows as columns. All orders of a grism have nearly the same slope; only
    their curvatures differ.
    """
    along, across = (float(part[1:].sum()) for part in trace.polynomials(0.0, 0.0))
    return across / along if abs(along) > abs(across) else 0.0


@dataclass(frozen=True, slots=True)
class _OrderPlan:
    """Properties of a spectral order of a grism that are the same for all sources.

    Attributes
    ----------
    order : Order
        The order.
    angstrom_per_pixel : float
        Dispersion along the trace, Angstrom per pixel.
    tile : int
        Number of pixels along a straight trace that are drawn with the same PSF; 0 if traces of this order are never
        drawn as straight.
    t : (float, float)
        Parameter t of the trace's polynomials at the first wavelength of the spectrum, and step of t from one
        wavelength to the next. t is 0 and 1 at the wavelengths `order.trace.first` and `order.trace.last`.
    bins : Bins
        Bins of wavelength in which the light of a spectrum is summed before it is drawn, with the PSF in them.
    """

    order: Order
    angstrom_per_pixel: float
    tile: int
    t: tuple[float, float]
    bins: Bins

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
        share = images.shares(order.wavelength, psf.planes.wavelength)
        return cls(order, angstrom_per_pixel, tile, t, Bins.from_trace(along, t, order.response, share, settings.bin))


@dataclass(frozen=True, slots=True)
class _OrderBatch:
    """Traces, stamps and light of one spectral order of k sources.

    Attributes
    ----------
    along, across : float array, shape (k, i)
        Coefficients of t^i (i from 0) of the displacement from the undispersed image in columns (`along`) and in rows
        (`across`), pixels. The parameter t is linear in wavelength.
    sizes : int array, shape (k,)
        Sides of the stamps (square images of the sources), pixels; 0 if the order of this source is too faint to be
        drawn or not on the detector.
    tiles : int array, shape (k,)
        Number of pixels along the trace that are drawn with the same PSF; 0 if the trace is not straight.
    expected : float array, shape (k,)
        Electrons of the whole order, on and outside the detector. If the response is negative, their absolute values
        are counted.
    peak : float array, shape (k,)
        Electrons (absolute values) in the brightest column of the order, summed over its rows.
    separable : bool array, shape (k,)
        True if the order is drawn as a product of two profiles.
    """

    along: Float
    across: Float
    sizes: Int
    tiles: Int
    expected: Float
    peak: Float
    separable: Bool

    @classmethod
    def from_spectra(
        cls, source_images: _SourceImages, batch: Int, spectra: Float32, plan: _OrderPlan, shape: tuple[int, int]
    ) -> _OrderBatch:
        peak, expected = np.empty(len(batch)), np.empty(len(batch))
        window = max(round(plan.angstrom_per_pixel), 1)
        kernels.measure_peak_and_total(
            spectra, source_images.sources.electrons[batch], plan.order.response, window, peak, expected
        )
        sizes, along, across, slope = source_images.sizes_on_frame(batch, plan, (peak, expected), shape)
        limit = source_images.sizes.limit * source_images.settings.separable / source_images.settings.edge
        is_separable = (peak < limit) & (sizes > 0) & (sizes <= LARGEST) & (slope <= _SEPARABLE_SLOPE)
        is_separable &= source_images.unextended[batch]
        tiles = np.where(slope <= _STRAIGHT, plan.tile, 0)
        return cls(along, across, sizes, tiles, expected, peak, is_separable)


class _SourceImages:
    """Undispersed images of sources, blurred by the PSF, which are computed for a few sources at a time when needed."""

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
        # The polynomials of position by which the PSF varies are valid only on the detector. A source outside is given
        # the PSF of the nearest position on the detector.
        column, row = np.clip(sources.column, 0.0, shape[1] - 1.0), np.clip(sources.row, 0.0, shape[0] - 1.0)
        node_weights = [
            transfer.basis_weights(psf, np.tile(part, (len(sources), 1)), column, row) for part in np.eye(count)
        ]
        self.weights = np.stack(node_weights, axis=1)
        self._planes = planes_cache
        # Sources without a given image or a trail, in coordinates in which traces are rows.
        self.unextended = self.straight & (sizes.extra_pixels == 0.0)

    def sizes_on_frame(
        self, batch: Int, plan: _OrderPlan, light: tuple[Float, Float], shape: tuple[int, int]
    ) -> tuple[Int, Float, Float, Float]:
        """Choose the stamps (square images of sources) of one spectral order of k sources.

        Parameters
        ----------
        batch : int array, shape (k,)
            Indices of the sources.
        plan : _OrderPlan
            The order.
        light : (float array, float array), each of shape (k,)
            Electrons of each spectrum in its brightest column, and in all columns.
        shape : (int, int)
            Number of rows and of columns of the detector.

        Returns
        -------
        sizes : int array, shape (k,)
            Sides of the stamps, pixels; 0 if the order is too faint to be drawn or not on the detector.
        along, across : float array, shape (k, i)
            Coefficients of the trace, as in `_OrderBatch`.
        slope : float array, shape (k,)
            Limit, of `_STRAIGHT` and `_SEPARABLE_SLOPE`, that the difference of the trace's slope from the slope of the
            images does not exceed, rows per column. It is infinite if the difference is larger or the trace turns back.
        """
        (ny, nx), (peak, expected), order = shape, light, plan.order
        column, row = self.sources.column[batch], self.sources.row[batch]
        along, across = (part.T for part in order.trace.polynomials(column, row))
        t = plan.t[0] + plan.t[1] * np.linspace(0.0, len(order.response) - 1.0, _PLACES)
        x, y = (np.polynomial.polynomial.polyval(t, part.T) for part in (along, across))
        limit = self.sizes.limit * (1.0 if order.trace.order == 1 else self.settings.faint / self.settings.edge)
        sizes = self.sizes.size(batch, peak, expected)
        left_edge, right_edge = column + x.min(axis=1), column + x.max(axis=1)
        low_edge, high_edge = row + y.min(axis=1), row + y.max(axis=1)
        off_frame = (
            (right_edge + sizes < 0) | (left_edge - sizes > nx) | (high_edge + sizes < 0) | (low_edge - sizes > ny)
        )
        across_step, along_step = np.diff(y, axis=1), np.diff(x, axis=1)
        one_way = (along_step > 0.0).all(axis=1) | (along_step < 0.0).all(axis=1)
        difference = np.abs(across_step - self.slope * along_step)
        straight = (difference <= _STRAIGHT * np.abs(along_step)).all(axis=1)
        moderate = (difference <= _SEPARABLE_SLOPE * np.abs(along_step)).all(axis=1)
        slope = np.where(one_way & straight, _STRAIGHT, np.where(one_way & moderate, _SEPARABLE_SLOPE, np.inf))
        not_drawn = off_frame | (peak < limit) | (peak <= 0.0)
        sizes = np.where(not_drawn, 0, sizes)
        return sizes, np.ascontiguousarray(along), np.ascontiguousarray(across), slope

    def stamp_sampling(self, size: int, smooth: bool = False) -> Sampling:
        """Return the sampling of stamps (square images of sources) with a side of `size` pixels.

        A galaxy larger than the largest stamp is drawn in two parts: its image blurred by a wide Gaussian filter (the
        smooth part), and the sharp rest. `smooth` selects the smooth part, and has no effect for smaller sources.
        """
        template = Sampling(size, self.settings.along, self.settings.across, self.slope, self.straight)
        return large_galaxies.stamp_sampling(size, template, smooth)

    def images(self, batch: Int, sampling: Sampling) -> Float32:
        """Return the images of the m sources with the indices `batch`, as spline coefficients.

        The result has the shape [m, b, n * along, n * across]: one image for each source and for each of the b
        wavelengths of the PSF. `sampling` contains the side n of an image in pixels, and its samples per pixel along
        and across the trace.
        """
        stamp_planes = self._stamp_planes(sampling)
        transforms = [images.spread_transform(stamp_planes, self.sources, i) for i in batch.tolist()]
        return images.coefficients(stamp_planes, self.weights[batch], self.profiles.take(batch), transforms)

    def profiles_of_images(self, batch: Int, sampling: Sampling) -> tuple[Float32, Float32]:
        """Return the profiles along and across the trace of the sources with the indices `batch` (see separable.py)."""
        return separable.profiles_of_images(
            self._stamp_planes(sampling), self.weights[batch], self.profiles.take(batch)
        )

    def _stamp_planes(self, sampling: Sampling) -> Planes:
        if sampling not in self._planes:
            self._planes[sampling] = images.planes(self.psf, sampling)
        return self._planes[sampling]

    def batch_size(self, sampling: Sampling) -> int:
        """Return for how many sources, at least 1, images with this sampling may be in memory at a time."""
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
    """Draw all spectral orders of the k sources with the indices `batch` on frames (images of the detector).

    `spectra`, shape (k, w), are the spectra of these sources. `orders` and `order_frames` have one element per order;
    all orders may have the same frame. The drawn electrons, and the sides of the stamps, are stored in `tally`.
    """
    sizes = np.stack([part.sizes for _, part in orders])
    # Spectral orders of a source that need stamps of similar size are drawn from one image, on the largest stamp.
    largest = sizes.max(axis=0)
    sizes = np.where((sizes > 0) & (sizes >= _SHARED_FRACTION * largest), largest, sizes)
    tally.sizes[batch] = np.maximum(tally.sizes[batch], largest)
    is_product = np.stack([part.separable for _, part in orders]) & (sizes <= LARGEST)
    _add_products(source_images, batch, spectra, orders, np.where(is_product, sizes, 0), order_frames, tally)
    sizes = np.where(is_product, 0, sizes)
    for size in np.unique(sizes[sizes > 0]).tolist():
        sampling = source_images.stamp_sampling(size)
        smooth = source_images.stamp_sampling(size, smooth=True) if size >= LARGE_GALAXY_SIZES[0] else None
        indices, count = np.flatnonzero((sizes == size).any(axis=0)), source_images.batch_size(sampling)
        for chunk in np.split(indices, range(count, len(indices), count)):
            for k, image in zip(chunk.tolist(), source_images.images(batch[chunk], sampling), strict=True):
                i = int(batch[k])
                smooth_image = None if smooth is None else source_images.images(batch[k : k + 1], smooth)[0]
                for m in np.flatnonzero(sizes[:, k] == size).tolist():
                    (plan, part), place = orders[m], source_images.places[i]
                    electrons = plan.bins.electrons(spectra[k], float(source_images.sources.electrons[i]))
                    path = part.along[k], part.across[k]
                    fallen = spreading.spread(
                        image, electrons, plan.bins.share, plan.bins.wave_share, *path, plan.t, plan.bins.width, place,
                        *sampling.rows, sampling.shape, int(part.tiles[k]), FIXED_POINT, order_frames[m],
                    )  # fmt: skip
                    if smooth is not None and smooth_image is not None:
                        fallen += large_galaxies.add(
                            smooth_image, electrons, plan.bins, path, plan.t, place, smooth, order_frames[m]
                        )
                    tally.electrons[i, m] = fallen


def _add_products(
    source_images: _SourceImages, batch: Int, spectra: Float32, orders: list[tuple[_OrderPlan, _OrderBatch]],
    sizes: Int, order_frames: list[Int], tally: Tally,
) -> None:  # fmt: skip
    """Draw faint spectral orders as products of two profiles, as `_add_orders` draws the others.

    `sizes` [orders, k] are the sides of the stamps, pixels; 0 for orders that are not drawn here.
    """
    for size in np.unique(sizes[sizes > 0]).tolist():
        sampling = source_images.stamp_sampling(size)
        (indices,) = np.nonzero((sizes == size).any(axis=0))
        profiles = source_images.profiles_of_images(batch[indices], sampling)
        for k, along_profile, across_profile in zip(indices.tolist(), *profiles, strict=True):
            i = int(batch[k])
            for m in np.flatnonzero(sizes[:, k] == size).tolist():
                plan, part = orders[m]
                electrons = plan.bins.electrons(spectra[k], float(source_images.sources.electrons[i]))
                tally.electrons[i, m] = separable.draw_product(
                    along_profile, across_profile, electrons, plan.bins.wave_share, part.along[k], part.across[k],
                    plan.t, plan.bins.width, source_images.places[i], sampling.shear, sampling.shape, FIXED_POINT,
                    order_frames[m],
                )  # fmt: skip
