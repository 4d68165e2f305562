"""Compute band fluxes of galaxies and stars from tables, hundreds of times faster than by integration.

Notes
-----
The flux of a galaxy in a band is a linear sum of its two templates and its emission lines. For one template and one
extinction law, the logarithm of the flux is a cumulant generating function of the extinction in the band. It is
therefore smooth in E(B-V) and in the Milky Way's A(V), and a polynomial of low order describes it. In redshift it is
interpolated by cubics on nodes uniform in ln(1 + z). The table of the reference band (0.1r) scales the templates to
the apparent magnitude in this band, which does not include lines. Lines, their extinction by the Milky Way, and lensing
need no table in redshift.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lake_schema import units
from lake_schema.arrays import Bool, Float, Float32, Int, Int32, UInt32
from truesky.fluxes import passbands
from truesky.fluxes.calibration import continuum_scale, star_scale
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.passbands import Passband
from truesky.fluxes.sources import Galaxies, Stars
from truesky.fluxes.spectra import extinction, lines
from truesky.fluxes.spectra.continuum import REFERENCE_BAND, TemplateMix
from truesky.fluxes.tables import build_tables, kernels
from truesky.fluxes.tables.build_tables import (
    A_V_LAST,
    EBV_LAST,
    LINE_SIGMA,
    LINE_STEP,
    STAR_A_V_LAST,
    Z_FIRST,
    Z_LAST,
    Setting,
)

# Resolution of the reference band's table. Its error enters the fluxes in all bands.
REFERENCE_SETTING = Setting(0.005, 6, 1)
# Number of galaxies that are interpolated together, so that their data stay in the processor's cache. A power of two
# would use only a fraction of the cache.
_CHUNK = 2000
# Width in ln(lambda) of the wavelength cells, in which the bands that contain a line are looked up.
_CELL = 0.01
# Margin in ln(lambda) of a cell on both sides. It covers the shift of 3e-4 between wavelengths in vacuum and air.
_AIR = 1e-3


@dataclass(frozen=True, slots=True)
class LineGrid:
    """Tables of emission-line fluxes in all bands, and wavelengths of the lines, for `kernels.sum_components`.

    Attributes
    ----------
    tables : float32 array, shape (sum of n_lambda, n_width)
        f_nu of a line of unit flux, by wavelength and line width. The tables of all bands follow one another.
    start : uint32 array, shape (n_band,)
        First row of each band in `tables`.
    last : int32 array, shape (n_band,)
        Index of the last row of each band, counted from the first row of the band.
    medium : uint32 array, shape (n_band,)
        1 for air, 0 for vacuum.
    first : float array, shape (n_band,)
        ln(lambda / A) of the first row of each band.
    cells : int array, shape (n_cell + 1,)
        Positions in `members` at which the bands of each wavelength cell begin. Cells are uniform in ln(lambda).
    members : uint32 array
        Indices of the bands that respond in each wavelength cell, one cell after the other.
    cell_first : float
        ln(lambda / A) at the start of the first cell.
    vacuum : float array, shape (n_line,)
        Rest-frame wavelengths of the lines in vacuum in A.
    """

    tables: Float32
    start: UInt32
    last: Int32
    medium: UInt32
    first: Float
    cells: Int
    members: UInt32
    cell_first: float
    vacuum: Float


@dataclass(frozen=True, slots=True)
class Grid:
    """Memory-mapped flux tables of galaxies in some bands.

    Attributes
    ----------
    settings : tuple of Setting
        Resolution of each band's table.
    tables : tuple of float32 array
        Chebyshev coefficients of each band, from `build_tables.galaxy_table`.
    reference : float32 array
        Chebyshev coefficients of the reference band.
    lines : LineGrid
        Tables of emission lines.
    milky_way : float array, shape (23401,)
        A(lambda) / A(V) on passbands.grid().
    """

    settings: tuple[Setting, ...]
    tables: tuple[Float32, ...]
    reference: Float32
    lines: LineGrid
    milky_way: Float


def open_grid(bands: Sequence[Passband], settings: Sequence[Setting], library: Library) -> Grid:
    """Return the flux tables of bands for a library of galaxies.

    A table that is not in the disc cache is computed, which takes half a second per band.

    Parameters
    ----------
    bands : sequence of Passband
        The passbands, at least one.
    settings : sequence of Setting
        Resolution of each band's table, one per band.
    library : Library
        Templates of galaxies.

    Returns
    -------
    Grid
        The tables.
    """
    key = build_tables.library_key(library)
    return Grid(
        tuple(settings),
        tuple(build_tables.galaxy_table(b, library, s, key) for b, s in zip(bands, settings, strict=True)),
        build_tables.galaxy_table(passbands.load(REFERENCE_BAND), library, REFERENCE_SETTING, key),
        _line_grid(bands),
        extinction.milky_way_table(passbands.GRID_FIRST, len(passbands.grid())),
    )


def galaxy_fluxes(rows: Galaxies, grid: Grid) -> Float:
    """Return the fluxes of galaxies by interpolation in tables, which approximates integration.galaxy_fluxes.

    Parameters
    ----------
    rows : Galaxies
        Galaxies for which `covered_galaxies` is True, which is not checked. Others get wrong fluxes.
    grid : Grid
        Tables from `open_grid`.

    Returns
    -------
    float array, shape (n, n_band)
        f_nu in microjansky.

    Notes
    -----
    flux_errors.csv has the error of each table resolution in each band.
    """
    # Sort by redshift, so that successive galaxies read the same rows of a table. Redshifts are rounded to 16-bit
    # integers: these are precise enough for the order, and are sorted ten times faster.
    span = 65_535.0 / np.log1p(Z_LAST - Z_FIRST)
    order = np.argsort((np.log1p(np.maximum(rows.mix.z_obs - Z_FIRST, 0.0)) * span).astype(np.uint16), kind="stable")
    out = np.empty((len(rows), len(grid.tables)))
    for start in range(0, len(rows), _CHUNK):
        indices = order[start : start + _CHUNK]
        _fill_chunk(rows.select(indices), grid, indices, out)
    return out


def _fill_chunk(rows: Galaxies, grid: Grid, indices: Int, out: Float) -> None:
    """Compute the fluxes (microjansky) of some galaxies, and write them to the rows `indices` of the array `out`."""
    log_z = np.log1p(rows.mix.z_obs)
    observed = _component_ratios(rows.mix, log_z, np.zeros(len(rows)), (REFERENCE_SETTING,), (grid.reference,))[0]
    ratios = _component_ratios(rows.mix, log_z, rows.a_v, grid.settings, grid.tables)
    scale = continuum_scale(rows.mag_r01, (rows.mix.frac * observed).sum(0))
    sigma = lines.velocity_dispersion(rows.abs_mag_r01, rows.mix.z_obs)
    width = np.clip(np.searchsorted(LINE_SIGMA, sigma, "right") - 1, 0, len(LINE_SIGMA) - 2)
    low, high = LINE_SIGMA[width] ** 2, LINE_SIGMA[width + 1] ** 2
    line_grid = grid.lines
    centre, flux = np.empty((*rows.lines.shape, 2)), np.empty((*rows.lines.shape, 2))
    kernels.line_centres(
        rows.lines, log_z, rows.a_v, line_grid.vacuum, lines.refractivity_terms(), grid.milky_way,
        float(passbands.GRID_FIRST), centre, flux,
    )  # fmt: skip
    kernels.sum_components(
        ratios,
        rows.mix.frac,
        scale,
        centre,
        flux,
        width,
        (sigma**2 - low) / (high - low),
        line_grid.tables,
        line_grid.start,
        line_grid.last,
        line_grid.medium,
        line_grid.first,
        LINE_STEP,
        line_grid.cells,
        line_grid.members,
        line_grid.cell_first,
        _CELL,
        units.ujy_of_cgs(rows.magnification),
        indices,
        out,
    )


def compile_kernels(grid: Grid) -> None:
    """Call the compiled loops for one invented galaxy, so that numba compiles them and caches the machine code."""
    ones, zeros = np.ones(1), np.zeros((2, 1))
    mix = TemplateMix(ones, zeros.astype(np.int64), zeros.astype(np.int64), zeros + 0.5, zeros)
    galaxy_fluxes(
        Galaxies(mix, -20.0 * ones, 20.0 * ones, np.full((1, len(lines.line_list())), 1e-17), ones, ones), grid
    )


def star_fluxes(rows: Stars, bands: Sequence[Passband], library: Library) -> Float:
    """Return the fluxes of stars by interpolation in tables.

    They differ from integration.star_fluxes by at most a fraction of 1e-6.

    Parameters
    ----------
    rows : Stars
        Stars for which `covered_stars` is True, which is not checked. Others get wrong fluxes.
    bands : sequence of Passband
        The passbands.
    library : Library
        Templates of stars.

    Returns
    -------
    float array, shape (n, n_band)
        f_nu in microjansky.
    """
    key = build_tables.library_key(library)
    basis = build_tables.chebyshev(rows.a_v, STAR_A_V_LAST, build_tables.STAR_COEFFICIENTS)
    scale = star_scale(rows, library)
    f_nu = np.empty((len(bands), len(rows)))
    for k, band in enumerate(bands):
        table = build_tables.star_table(band, library, key)
        kernels.mix_stars(table, rows.sed, rows.frac, basis, scale, f_nu[k])
    return units.ujy_of_cgs(f_nu).T


def covered_galaxies(rows: Galaxies) -> Bool:
    """Return True for galaxies within the flux tables' ranges of redshift, E(B-V) and Milky Way A(V), bool[n].

    The E(B-V) of a template without flux, or without an extinction law, does not matter.
    """
    mix = rows.mix
    dusty = (mix.ebv > EBV_LAST) & (mix.law > 0) & (mix.frac > 0.0)
    in_range = (mix.z_obs >= Z_FIRST) & (mix.z_obs <= Z_LAST)
    return np.asarray(in_range & ~dusty.any(0) & (rows.a_v <= A_V_LAST))


def covered_stars(rows: Stars) -> Bool:
    """Return True for stars whose A(V) is at most 5 mag, the largest of the flux tables; bool[n]."""
    return np.asarray(rows.a_v <= STAR_A_V_LAST)


def _component_ratios(
    mix: TemplateMix, log_z: Float, a_v: Float, settings: Sequence[Setting], tables: Sequence[Float32]
) -> Float32:
    """Return f_nu in each band / rest-frame f_nu in the reference band, for each galaxy's two templates behind dust.

    The shape of the result is (n_band, 2, n).
    """
    # Most bands share redshift nodes or Chebyshev polynomials, so that each different one is computed only once.
    distinct = set(settings)
    steps = {s.step: s for s in distinct}
    nodes = {step: _find_nodes(setting, mix, log_z) for step, setting in steps.items()}
    orders = {(s.n_ebv, s.n_av): s for s in distinct}
    products = {order: _chebyshev_products(setting, mix, a_v) for order, setting in orders.items()}
    out = np.empty((len(tables), 2, len(mix)), np.float32)
    for k, (setting, table) in enumerate(zip(settings, tables, strict=True)):
        kernels.log_ratios(table, *nodes[setting.step], products[setting.n_ebv, setting.n_av], out[k])
    return np.exp(out, out=out)


def _find_nodes(setting: Setting, mix: TemplateMix, log_z: Float) -> tuple[Int, Float32]:
    first, z_weights = np.empty((2, len(mix)), np.int64), np.empty((len(mix), 4), np.float32)
    n_law = extinction.LAW_COUNT - 1
    kernels.find_nodes(
        log_z, mix.sed, mix.law, n_law, setting.log_z(0), setting.step, setting.z_count, first, z_weights
    )
    return first, z_weights


def _chebyshev_products(setting: Setting, mix: TemplateMix, a_v: Float) -> Float32:
    basis = np.empty((2, len(mix), setting.n_ebv * setting.n_av), np.float32)
    kernels.chebyshev_products(mix.law, mix.ebv, a_v, EBV_LAST, A_V_LAST, setting.n_ebv, setting.n_av, basis)
    return basis


def _line_grid(bands: Sequence[Passband]) -> LineGrid:
    firsts, tables = zip(*(build_tables.line_table(band) for band in bands), strict=True)
    rows = np.array([len(table) for table in tables])
    medium = np.array([band.medium == "air" for band in bands], np.uint32)
    first = np.array(firsts)
    cell_first = float(np.log(passbands.GRID_FIRST)) - _AIR
    count = int((np.log(passbands.GRID_LAST + 1.0) - cell_first) / _CELL) + 1
    blue = cell_first + _CELL * np.arange(count)[:, None] - _AIR
    cell, member = np.nonzero((blue <= first + LINE_STEP * rows) & (blue + _CELL + 2.0 * _AIR >= first))
    cells = np.searchsorted(cell, np.arange(count + 1))
    vacuum = np.array([line.vacuum for line in lines.line_list()])
    start, last = (np.cumsum(rows) - rows).astype(np.uint32), (rows - 1).astype(np.int32)
    return LineGrid(
        np.concatenate(tables), start, last, medium, first, cells, member.astype(np.uint32), cell_first, vacuum
    )
