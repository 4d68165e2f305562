"""Truth of spectra: where each source's orders lie on a detector, what of them overlaps, how well lines are seen.

traced     rows of it
overlaps   which traces lie beside which
lines_of   emission lines of galaxies in a first order
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter

from lake_schema import units
from lake_schema.arrays import Bool, Float, Int
from truesky.fluxes import passbands
from truesky.fluxes.libraries import templates
from truesky.fluxes.sources import GALAXY_KINDS, galaxies_of
from truesky.fluxes.spectra import extinction, lines
from truesky.render.camera.traces import Trace
from truesky.render.channels.aim import Aim
from truesky.render.dispersing.draw import Tally
from truesky.render.effects.scene import Scene
from truesky.render.exposure.records import Rows
from truesky.render.exposure.visible_sources import Light
from truesky.render.sources import colours, galaxy_shapes

# Pixels of a trace that are compared at a time; places along a trace between which it is taken as straight; the widest
# a trace is taken to be, half, pixels.
_BIN, _PLACES, _WIDEST = 8, 33, 20.0
# Electrons a column of a trace that counts as a contaminant, of a pixel's noise.  In an extraction that is as long as
# wide, such as of a resolution element, it then brings at least as much light as there is noise: a bias of one sigma.
MATTERS = 1.0

Columns = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Paths:
    """Traces of n orders of sources on a detector.

    source : int[n] which;  order : int[n]
    along  : [n] polynomials: columns of t^i;  across : rows
    half   : float64[n] half of their widths, pixels
    level  : float64[n] electrons a column on the detector, in the mean
    """

    source: Int
    order: Int
    along: list[Float]
    across: list[Float]
    half: Float
    level: Float


def traced(light: Light, tally: Tally, aim: Aim, rows: Rows, scene: Scene) -> Columns:
    """Columns of the table `rendered_spectra`, but for exposure and detector, one row an order with light there.

    light : what shines onto the detector;  tally : what each source brought to it
    aim, rows, scene : the exposure and detector, the catalogue rows, and what effects know
    """
    assert light.dispersed is not None
    sources, orders = light.sources, light.dispersed.orders
    numbers = np.array([order.trace.order for order in orders])
    # Ascending identifier, ascending order.
    by_order = np.argsort(numbers)
    source, at = np.nonzero(tally.electrons[:, by_order] > 0.0)
    which = by_order[at]
    paths = _paths(light, tally, source, which, aim)
    part, beside = overlaps(paths, aim.detector.nx, MATTERS * scene.pixel_noise)
    seen = lines_of(light, source, paths, aim, rows, scene)
    first = paths.order == 1
    return {
        "id": sources.ids[source],
        "order": paths.order,
        "wavelength_first": np.array([orders[m].trace.first for m in which], float),
        "wavelength_last": np.array([orders[m].trace.last for m in which], float),
        **{f"{axis}_first": np.array([p[0] for p in found], float) for axis, found in _axes(paths)},
        **{f"{axis}_last": np.array([p.sum() for p in found], float) for axis, found in _axes(paths)},
        **{f"trace_{axis}": found for axis, found in _axes(paths)},
        "expected": tally.expected[source, which],
        "drawn": tally.electrons[source, which],
        "overlapped": np.ma.masked_array(part, ~first),
        "contaminants": [np.unique(sources.ids[other]) if len(other) else sources.ids[:0] for other in beside],
        **seen,
    }


def _axes(paths: Paths) -> tuple[tuple[str, list[Float]], tuple[str, list[Float]]]:
    return ("x", paths.along), ("y", paths.across)


def _paths(light: Light, tally: Tally, source: Int, which: Int, aim: Aim) -> Paths:
    assert light.dispersed is not None
    assert light.psf is not None
    sources, scale = light.sources, light.psf.pixel_scale
    body = sources.shape >= 0
    half = np.full(len(sources), 0.5 * light.psf.fwhm / scale)
    half[body] += galaxy_shapes.half_light(sources.shapes.take(sources.shape[body])) / scale
    for i in np.unique(source).tolist():
        picture = None if body[i] else sources.picture_of(i)
        half[i] += 0.0 if picture is None else picture.half_light / scale
    half += 0.5 * sources.length
    along, across = ([np.zeros(0)] * len(source) for _ in "xy")
    order, columns = np.zeros(len(source), np.int64), np.ones(len(source))
    for m, one in enumerate(light.dispersed.orders):
        (own,) = np.nonzero(which == m)
        order[own] = one.trace.order
        column, row = sources.column[source[own]], sources.row[source[own]]
        x, y = one.trace.polynomials(column, row)
        x[0] += column
        y[0] += row
        low, high = np.sort([x[0], x.sum(axis=0)], axis=0)
        columns[own] = np.maximum(np.minimum(high, aim.detector.nx - 1.0) - np.maximum(low, 0.0), 1.0)
        for k, own_x, own_y in zip(own.tolist(), x.T.copy(), y.T.copy(), strict=True):
            along[k], across[k] = own_x, own_y
    level = tally.electrons[source, which] / columns
    return Paths(source, order, along, across, np.minimum(half, _WIDEST)[source], level)


# ---------------------------------------------------------------------------------------------- what overlaps


def overlaps(paths: Paths, nx: int, least: float) -> tuple[Float, list[Int]]:
    """(float64[n] part of each first order beside which others lie, their sources), 0 and none of other orders.

    paths : traces on a detector of nx columns;  least : electrons a column of a trace that counts
    Error : in steps of 8 pixels of the trace's length
    """
    path, at, row = _bins(paths, nx)
    order = np.argsort(at, kind="stable")
    path, at, row = path[order], at[order], row[order]
    ends = np.searchsorted(at, np.arange(at.max(initial=-1) + 2))
    covered, sources = np.zeros(len(paths.order)), int(paths.source.max(initial=0)) + 1
    before, found = np.zeros(0, np.int64), [np.zeros(0, np.int64)]
    for start, stop in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True):
        target, other = _near(paths, path[start:stop], row[start:stop], least)
        beside = np.zeros(len(covered), bool)
        beside[target] = True
        covered += beside
        # Most pairs go on from bin to bin: a pair is held where it begins.
        pairs = np.unique(target * sources + paths.source[other])
        found.append(np.setdiff1d(pairs, before, assume_unique=True))
        before = pairs
    length = np.bincount(path, minlength=len(covered))
    first, source = np.divmod(np.unique(np.concatenate(found)), sources)
    split = np.searchsorted(first, np.arange(1, len(covered)))
    return covered / np.maximum(length, 1), np.split(source, split) if len(covered) else []


def _near(paths: Paths, path: Int, row: Float, least: float) -> tuple[Int, Int]:
    """(first orders, traces of other sources beside them) of those that pass one bin at rows."""
    loud = np.flatnonzero(paths.level[path] >= least)
    loud = loud[np.argsort(row[loud], kind="stable")]
    first = np.flatnonzero(paths.order[path] == 1)
    widest = float(paths.half[path[loud]].max(initial=0.0))
    reach = paths.half[path[first]] + widest
    low = np.searchsorted(row[loud], row[first] - reach)
    count = np.searchsorted(row[loud], row[first] + reach, "right") - low
    target = np.repeat(first, count)
    begin = np.repeat(low - (np.cumsum(count) - count), count)
    other = loud[begin + np.arange(len(target))] if len(target) else loud[:0]
    apart = np.abs(row[target] - row[other])
    touch = apart < paths.half[path[target]] + paths.half[path[other]]
    touch &= paths.source[path[target]] != paths.source[path[other]]
    return path[target[touch]], path[other[touch]]


def _bins(paths: Paths, nx: int) -> tuple[Int, Int, Float]:
    """(path, bin of 8 columns, row there) of all traces on the detector."""
    t = np.linspace(0.0, 1.0, _PLACES)
    column, row = (np.polynomial.polynomial.polyval(t, _together(part).T) for part in (paths.along, paths.across))
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


def _together(polynomials: list[Float]) -> Float:
    """[n, i] coefficients of polynomials, those that one does not have 0."""
    out = np.zeros((len(polynomials), max((len(part) for part in polynomials), default=1)))
    for own, part in zip(out, polynomials, strict=True):
        own[: len(part)] = part
    return out


# ---------------------------------------------------------------------------------------------- lines


def lines_of(light: Light, source: Int, paths: Paths, aim: Aim, rows: Rows, scene: Scene) -> Columns:
    """Columns of emission lines on the detector, of first orders of galaxies whose lines are known.

    light, source, paths : sources, and those of the traces;  aim, rows, scene : as of `traced`
    Error : of the signal-to-noise ratio 20 %: a galaxy is taken as a Gaussian
    """
    assert light.dispersed is not None
    names = ("line_wavelength", "line_expected", "line_snr")
    found: Columns = {name: [np.zeros(0)] * len(source) for name in names}
    known = _with_lines(light, source, paths, rows)
    if not known.any():
        return found
    at = np.flatnonzero(known)
    own = galaxies_of(rows.galaxies.take(light.of[source[at]]), rows.library or templates.galaxy_library())
    vacuum = np.array([line.vacuum for line in lines.line_list()])
    wavelength = lines.observed_wavelength(vacuum[None], own.mix.z_obs[:, None], "vacuum")
    curve = extinction.milky_way(wavelength.ravel()).reshape(wavelength.shape)
    dimmed = own.magnification[:, None] * extinction.transmitted(curve, own.a_v[:, None])
    response = np.interp(wavelength, aim.band.wavelength, aim.band.response, left=0.0, right=0.0)
    # Square centimetres times seconds, by the exposure's own zero point, as all that is drawn.
    area = aim.electrons / units.electron_rate(1.0, 1.0, passbands.log_width(aim.band))
    electrons = own.lines * dimmed * response * area * wavelength / (units.PLANCK_ERG_S * units.LIGHT_ANGSTROM_S)
    electrons *= light.let_through[source[at]][:, None]
    (first,) = (order.trace for order in light.dispersed.orders if order.trace.order == 1)
    continuum = paths.level[at] / np.maximum(2.0 * paths.half[at], 1.0)
    noise = _image_area(light, source[at]) * (scene.pixel_noise**2 + continuum)
    snr = electrons / np.sqrt(noise[:, None] + np.maximum(electrons, 1e-30))
    for i, own_wave, own_light, own_snr in zip(at.tolist(), wavelength, electrons, snr, strict=True):
        some = (own_light > 0.0) & _on_detector(first, (paths.along[i], paths.across[i]), own_wave, aim)
        for name, values in zip(names, (own_wave, own_light, own_snr), strict=True):
            found[name][i] = values[some]
    return found


def _on_detector(trace: Trace, path: tuple[Float, Float], wavelength: Float, aim: Aim) -> Bool:
    """[n] Whether the middle of a line falls onto a pixel; path : columns and rows, polynomials of t."""
    t = (wavelength - trace.first) / (trace.last - trace.first)
    column, row = (np.polynomial.polynomial.polyval(t, part) for part in path)
    here = (column > -0.5) & (column < aim.detector.nx - 0.5)
    return np.asarray(here & (row > -0.5) & (row < aim.detector.ny - 0.5))


def _with_lines(light: Light, source: Int, paths: Paths, rows: Rows) -> Bool:
    """[n] First orders of galaxies; pictures of lenses are not told apart by their lines."""
    if not len(rows.galaxies) or not set(colours.GALAXY_COLUMNS) <= set(rows.galaxies.column_names):
        return np.zeros(len(source), bool)
    kinds = rows.galaxies["kind"].to_numpy() if "kind" in rows.galaxies.column_names else np.zeros(len(rows.galaxies))
    body = light.sources.shape[source] >= 0
    usual = np.isin(kinds[np.where(body, light.of[source], 0)], GALAXY_KINDS)
    return np.asarray((paths.order == 1) & body & usual)


def _image_area(light: Light, source: Int) -> Float:
    """[n] pixels: one over the sum of the squares of a source's image, of unit sum; those of Gaussians add up."""
    assert light.psf is not None
    assert light.psf.planes is not None
    planes, scale = light.psf.planes, light.psf.pixel_scale
    radius = galaxy_shapes.half_light(light.sources.shapes.take(light.sources.shape[source])) / scale
    # In a pixel that is anywhere.
    pixel = uniform_filter(planes.images.mean(axis=0, dtype=float), planes.samples) * planes.samples**2
    point = planes.samples**2 / float((pixel**2).sum())
    # A Gaussian with the second moments of an exponential disc, whose scale length is the half-light radius over 1.678.
    return np.asarray(point + 12.0 * np.pi * (radius / 1.678) ** 2)
