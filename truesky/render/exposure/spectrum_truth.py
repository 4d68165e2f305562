"""Compute the truth of slitless spectra on a detector, for the table `rendered_spectra`.

The truth is the trace of each spectral order of a source, the overlaps with traces of other sources, and the expected
electrons and signal-to-noise ratios of emission lines.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from lake_schema import units
from lake_schema.arrays import Bool, Float, Int
from truesky.fluxes import passbands
from truesky.fluxes.libraries import templates
from truesky.fluxes.sources import GALAXY_KINDS, galaxies_from_table
from truesky.fluxes.spectra import extinction, lines
from truesky.render.camera.traces import Trace
from truesky.render.channels.aim import Aim
from truesky.render.dispersing.draw import Tally
from truesky.render.effects.scene import Scene
from truesky.render.exposure.records import Rows
from truesky.render.exposure.visible_sources import Light
from truesky.render.sources import colours, galaxy_shapes

# Width of the bins of columns in which traces are compared, pixels.
_BIN = 8
# Number of points at which the position of a trace is computed. Between them it is treated as straight.
_PLACES = 33
# Largest half width of a trace, pixels; wider traces are treated as having this half width.
_WIDEST = 20.0
# Smallest light of a trace with which it counts as a contaminant of other spectra: its electrons per column, divided by
# the noise of a pixel (electrons rms). In an extraction window of n x n pixels, the light of such a trace equals the
# noise: a bias of one sigma.
MIN_CONTAMINATION = 1.0

Columns = dict[str, Any]


@dataclass(frozen=True, slots=True)
class TracePaths:
    """Traces of n spectra on a detector; each is one spectral order of one source.

    Attributes
    ----------
    source : int array, shape (n,)
        Index of the source in the list of drawn sources.
    order : int array, shape (n,)
        Spectral order of the grism.
    along, across : list of float array, length n
        Coefficients of t^i (i from 0) for the column and the row, 0-based pixels, with t from 0 to 1 along the trace.
    half : float64 array, shape (n,)
        Half widths of the traces, pixels.
    level : float64 array, shape (n,)
        Mean electrons of the trace in each column that it covers on the detector.
    """

    source: Int
    order: Int
    along: list[Float]
    across: list[Float]
    half: Float
    level: Float


def truth_columns(light: Light, tally: Tally, aim: Aim, rows: Rows, scene: Scene) -> Columns:
    """Return the columns of the table `rendered_spectra`: one row per spectral order of a source on the detector.

    Parameters
    ----------
    light : Light
        Sources with their spectra and the orders of the grism.
    tally : Tally
        Electrons of each source and order that were drawn on the detector. Orders with 0 electrons have no row.
    aim : Aim
        Exposure and detector.
    rows : Rows
        Catalogue rows of the sources.
    scene : Scene
        Properties of the exposure, with the noise of a pixel.

    Returns
    -------
    dict of str to array
        Columns by name, sorted by identifier and order. The columns that name the exposure and the detector are not
        included.
    """
    assert light.dispersed is not None
    sources, orders = light.sources, light.dispersed.orders
    numbers = np.array([order.trace.order for order in orders])
    # Rows are sorted by the identifier of the source, then by spectral order.
    by_order = np.argsort(numbers)
    source, at = np.nonzero(tally.electrons[:, by_order] > 0.0)
    order_index = by_order[at]
    paths = _find_paths(light, tally, source, order_index, aim)
    overlap, contaminants = find_overlaps(paths, aim.detector.nx, MIN_CONTAMINATION * scene.pixel_noise)
    line_columns = emission_line_columns(light, source, paths, aim, rows, scene)
    first = paths.order == 1
    return {
        "id": sources.ids[source],
        "order": paths.order,
        "wavelength_first": np.array([orders[m].trace.first for m in order_index], float),
        "wavelength_last": np.array([orders[m].trace.last for m in order_index], float),
        **{f"{axis}_first": np.array([p[0] for p in polynomials], float) for axis, polynomials in _axes(paths)},
        **{f"{axis}_last": np.array([p.sum() for p in polynomials], float) for axis, polynomials in _axes(paths)},
        **{f"trace_{axis}": polynomials for axis, polynomials in _axes(paths)},
        "expected": tally.expected[source, order_index],
        "drawn": tally.electrons[source, order_index],
        "overlapped": np.ma.masked_array(overlap, ~first),
        "contaminants": [np.unique(sources.ids[other]) if len(other) else sources.ids[:0] for other in contaminants],
        **line_columns,
    }


def _axes(paths: TracePaths) -> tuple[tuple[str, list[Float]], tuple[str, list[Float]]]:
    return ("x", paths.along), ("y", paths.across)


def _find_paths(light: Light, tally: Tally, source: Int, order_index: Int, aim: Aim) -> TracePaths:
    assert light.dispersed is not None
    assert light.psf is not None
    sources, scale = light.sources, light.psf.pixel_scale
    is_galaxy = sources.shape >= 0
    half = np.full(len(sources), 0.5 * light.psf.fwhm / scale)
    half[is_galaxy] += galaxy_shapes.half_light(sources.shapes.take(sources.shape[is_galaxy])) / scale
    for i in np.unique(source).tolist():
        picture = None if is_galaxy[i] else sources.picture_of(i)
        half[i] += 0.0 if picture is None else picture.half_light / scale
    half += 0.5 * sources.trail_length
    along, across = ([np.zeros(0)] * len(source) for _ in "xy")
    order, columns = np.zeros(len(source), np.int64), np.ones(len(source))
    for m, dispersed_order in enumerate(light.dispersed.orders):
        (indices,) = np.nonzero(order_index == m)
        order[indices] = dispersed_order.trace.order
        column, row = sources.column[source[indices]], sources.row[source[indices]]
        x, y = dispersed_order.trace.polynomials(column, row)
        x[0] += column
        y[0] += row
        low, high = np.sort([x[0], x.sum(axis=0)], axis=0)
        columns[indices] = np.maximum(np.minimum(high, aim.detector.nx - 1.0) - np.maximum(low, 0.0), 1.0)
        for k, path_x, path_y in zip(indices.tolist(), x.T.copy(), y.T.copy(), strict=True):
            along[k], across[k] = path_x, path_y
    level = tally.electrons[source, order_index] / columns
    return TracePaths(source, order, along, across, np.minimum(half, _WIDEST)[source], level)


def find_overlaps(paths: TracePaths, nx: int, min_level: float) -> tuple[Float, list[Int]]:
    """Find the first-order spectra that are overlapped by traces of other sources.

    Parameters
    ----------
    paths : TracePaths
        All n traces on a detector.
    nx : int
        Number of columns of the detector.
    min_level : float
        Electrons per column from which a trace counts as a contaminant.

    Returns
    -------
    covered : float64 array, shape (n,)
        Fraction of the length of each first-order trace on the detector that is overlapped; 0 for other orders.
    sources : list of int array, length n
        For each first-order trace, indices of the sources that overlap it; empty for other orders.

    Notes
    -----
    Overlaps are found in bins of 8 columns. In a bin, two traces overlap if the distance of their rows is less than the
    sum of their half widths.
    """
    path, at, row = _bins(paths, nx)
    order = np.argsort(at, kind="stable")
    path, at, row = path[order], at[order], row[order]
    ends = np.searchsorted(at, np.arange(at.max(initial=-1) + 2))
    covered, sources = np.zeros(len(paths.order)), int(paths.source.max(initial=0)) + 1
    previous_pairs, new_pairs = np.zeros(0, np.int64), [np.zeros(0, np.int64)]
    for start, stop in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True):
        target, other = _find_neighbours(paths, path[start:stop], row[start:stop], min_level)
        is_overlapped = np.zeros(len(covered), bool)
        is_overlapped[target] = True
        covered += is_overlapped
        # Most pairs of overlapping traces continue from one bin of columns to the next. To save memory, a pair is
        # stored only in the first of successive bins.
        pairs = np.unique(target * sources + paths.source[other])
        new_pairs.append(np.setdiff1d(pairs, previous_pairs, assume_unique=True))
        previous_pairs = pairs
    length = np.bincount(path, minlength=len(covered))
    first, source = np.divmod(np.unique(np.concatenate(new_pairs)), sources)
    split = np.searchsorted(first, np.arange(1, len(covered)))
    return covered / np.maximum(length, 1), np.split(source, split) if len(covered) else []


def _find_neighbours(paths: TracePaths, path: Int, row: Float, min_level: float) -> tuple[Int, Int]:
    """Return the pairs of a first-order trace and a trace of another source that overlap in one bin of columns.

    `path` and `row`, both with one element per trace in this bin, are the index of the trace and its row in pixels.
    Traces with fewer than `min_level` electrons per column are not contaminants. The result is two arrays of indices of
    traces.
    """
    bright = np.flatnonzero(paths.level[path] >= min_level)
    bright = bright[np.argsort(row[bright], kind="stable")]
    first = np.flatnonzero(paths.order[path] == 1)
    widest = float(paths.half[path[bright]].max(initial=0.0))
    reach = paths.half[path[first]] + widest
    low = np.searchsorted(row[bright], row[first] - reach)
    count = np.searchsorted(row[bright], row[first] + reach, "right") - low
    target = np.repeat(first, count)
    begin = np.repeat(low - (np.cumsum(count) - count), count)
    other = bright[begin + np.arange(len(target))] if len(target) else bright[:0]
    separation = np.abs(row[target] - row[other])
    touches = separation < paths.half[path[target]] + paths.half[path[other]]
    touches &= paths.source[path[target]] != paths.source[path[other]]
    return path[target[touches]], path[other[touches]]


def _bins(paths: TracePaths, nx: int) -> tuple[Int, Int, Float]:
    """Divide all traces into bins of 8 columns of the detector, and return (trace, bin, row) of each piece.

    A piece is the part of one trace in one bin. The three arrays have one element per piece: the index of the trace,
    the number of the bin (from 0 at column 0), and the row of the trace in the middle of the bin, pixels. Pieces
    outside the `nx` columns of the detector are not included.
    """
    t = np.linspace(0.0, 1.0, _PLACES)
    column, row = (
        np.polynomial.polynomial.polyval(t, _stack_coefficients(part).T) for part in (paths.along, paths.across)
    )
    order = np.argsort(column, axis=1)
    column, row = (np.take_along_axis(part, order, axis=1) for part in (column, row))
    low, high = np.maximum(column[:, 0], 0.0), np.minimum(column[:, -1], nx - 1.0)
    first = low.astype(int) // _BIN
    count = np.where(high >= low, high.astype(int) // _BIN - first + 1, 0)
    path, ends = np.repeat(np.arange(len(count)), count), np.cumsum(count)
    at = np.arange(len(path)) - np.repeat(ends - count - first, count)
    rows, middle = np.empty(len(path)), (at + 0.5) * _BIN
    for i, (start, stop) in enumerate(zip((ends - count).tolist(), ends.tolist(), strict=True)):
        rows[start:stop] = np.interp(middle[start:stop], column[i], row[i])
    return path, at, rows


def _stack_coefficients(polynomials: list[Float]) -> Float:
    """Return the coefficients of n polynomials in t as one array; column i belongs to t^i and is 0 above the degree."""
    out = np.zeros((len(polynomials), max((len(coefficients) for coefficients in polynomials), default=1)))
    for row, coefficients in zip(out, polynomials, strict=True):
        row[: len(coefficients)] = coefficients
    return out


def emission_line_columns(light: Light, source: Int, paths: TracePaths, aim: Aim, rows: Rows, scene: Scene) -> Columns:
    """Return columns with the emission lines of each trace that lie on the detector.

    Only first-order spectra of catalogue galaxies have lines. For other traces the arrays are empty.

    Parameters
    ----------
    light : Light
        Sources with their spectra and the orders of the grism.
    source : int array, shape (n,)
        Index of the source of each trace in the list of drawn sources.
    paths : TracePaths
        The n traces on the detector.
    aim, rows, scene : Aim, Rows, Scene
        Exposure and detector; catalogue rows of the sources; and properties of the exposure, with the noise of a pixel.

    Returns
    -------
    dict of str to list of float array
        Columns `line_wavelength` (observed, vacuum, Angstrom), `line_expected` (electrons) and `line_snr`
        (signal-to-noise ratio), each with one array per trace.

    Notes
    -----
    The error of the signal-to-noise ratio is 20 %, because the image of a galaxy is treated as a Gaussian.
    """
    assert light.dispersed is not None
    names = ("line_wavelength", "line_expected", "line_snr")
    columns: Columns = {name: [np.zeros(0)] * len(source) for name in names}
    has_lines = _has_lines(light, source, paths, rows)
    if not has_lines.any():
        return columns
    at = np.flatnonzero(has_lines)
    galaxies = galaxies_from_table(
        rows.galaxies.take(light.spectrum_rows[source[at]]), rows.galaxy_library or templates.galaxy_library()
    )
    vacuum = np.array([line.vacuum for line in lines.line_list()])
    wavelength = lines.observed_wavelength(vacuum[None], galaxies.mix.z_obs[:, None], "vacuum")
    curve = extinction.milky_way(wavelength.ravel()).reshape(wavelength.shape)
    dimmed = galaxies.magnification[:, None] * extinction.transmission(curve, galaxies.a_v[:, None])
    response = np.interp(wavelength, aim.band.wavelength, aim.band.response, left=0.0, right=0.0)
    # Collecting area times exposure time, cm2 s. It is derived from the zero point of the exposure, so that lines agree
    # with the drawn light.
    area = aim.electrons_per_microjansky / units.electron_rate(1.0, 1.0, passbands.log_width(aim.band))
    electrons = galaxies.lines * dimmed * response * area * wavelength / (units.PLANCK_ERG_S * units.LIGHT_ANGSTROM_S)
    electrons *= light.let_through[source[at]][:, None]
    (first,) = (order.trace for order in light.dispersed.orders if order.trace.order == 1)
    continuum = paths.level[at] / np.maximum(2.0 * paths.half[at], 1.0)
    noise = _image_area(light, source[at]) * (scene.pixel_noise**2 + continuum)
    snr = electrons / np.sqrt(noise[:, None] + np.maximum(electrons, 1e-30))
    is_visible = (electrons > 0.0) & _is_on_detector(first, paths, at, wavelength, aim)
    for name, values in zip(names, (wavelength, electrons, snr), strict=True):
        for i, trace_values, selected in zip(at.tolist(), values, is_visible, strict=True):
            columns[name][i] = trace_values[selected]
    return columns


def _is_on_detector(trace: Trace, paths: TracePaths, at: Int, wavelength: Float, aim: Aim) -> Bool:
    """Return the mask [k, n] of the wavelengths [k, n] whose light on k traces falls onto a pixel of the detector.

    `at` [k] are the indices of the traces in `paths`. Their polynomials have the variable t, which increases linearly
    from 0 at the wavelength `trace.first` to 1 at the wavelength `trace.last`, Angstrom. `aim` is the exposure and the
    detector.
    """
    t = (wavelength - trace.first) / (trace.last - trace.first)
    polynomials = (_stack_coefficients([part[i] for i in at.tolist()]).T for part in (paths.along, paths.across))
    column, row = (np.polynomial.polynomial.polyval(t, part[:, :, None], tensor=False) for part in polynomials)
    in_columns = (column > -0.5) & (column < aim.detector.nx - 0.5)
    return np.asarray(in_columns & (row > -0.5) & (row < aim.detector.ny - 0.5))


def _has_lines(light: Light, source: Int, paths: TracePaths, rows: Rows) -> Bool:
    """Return the mask of the traces that are first-order spectra of catalogue galaxies with known emission lines.

    It is False for gravitational arcs, and for rows of the table `galaxies` whose column `kind` has another value than
    a galaxy. It is False for all traces if the rows lack the columns from which lines are computed.
    """
    if not len(rows.galaxies) or not set(colours.GALAXY_COLUMNS) <= set(rows.galaxies.column_names):
        return np.zeros(len(source), bool)
    galaxy_kinds = (
        rows.galaxies["kind"].to_numpy() if "kind" in rows.galaxies.column_names else np.zeros(len(rows.galaxies))
    )
    is_galaxy = light.sources.shape[source] >= 0
    is_catalogue_galaxy = np.isin(galaxy_kinds[np.where(is_galaxy, light.spectrum_rows[source], 0)], GALAXY_KINDS)
    return np.asarray((paths.order == 1) & is_galaxy & is_catalogue_galaxy)


def _image_area(light: Light, source: Int) -> Float:
    """Return the effective area of the images of galaxies, pixels, over which noise adds up in an optimal measurement.

    It is 1 / (sum of the squared pixels) of an image with sum 1. The areas of the PSF and of the profile of a galaxy
    are added, as for Gaussians. `source` are indices of the sources.
    """
    assert light.psf is not None
    assert light.psf.planes is not None
    planes, scale = light.psf.planes, light.psf.pixel_scale
    radius = galaxy_shapes.half_light(light.sources.shapes.take(light.sources.shape[source])) / scale
    # Effective area of the PSF, 1 / (sum of the squared pixels). The PSF is first averaged over all positions of the
    # source within a pixel.
    pixel = scipy.ndimage.uniform_filter(planes.images.mean(axis=0, dtype=float), planes.samples) * planes.samples**2
    point = planes.samples**2 / float((pixel**2).sum())
    # A galaxy is treated as a Gaussian with the second moments of an exponential disc, whose scale length is the
    # half-light radius / 1.678.
    return np.asarray(point + 12.0 * np.pi * (radius / 1.678) ** 2)
