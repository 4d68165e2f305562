"""Band fluxes of galaxies and stars from tables: hundreds of times faster than integrating.

Grid, open_grid   the tables of some bands, made where the cache has them not
galaxies, stars   f_nu of checked rows
warm              compile what computes galaxies
covered           which galaxies the tables cover; covered_stars

A band's flux is linear in a galaxy's two components and additive in its lines. The logarithm of one template's, behind
one law, is smooth in E(B-V) and in the Milky Way's A_V, being a cumulant generating function of the extinction in the
band: a polynomial of low order. In redshift it is interpolated by cubics, uniform in ln(1 + z). The reference band's
own table brings the sum to the apparent reference magnitude. Lines, the lens and the Milky Way in front of lines need
no grid.
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

# Of the reference band: its error is everybody's.
REFERENCE_SETTING = Setting(0.005, 6, 1)
# Rows that are interpolated together: what is known of them stays in the processor's cache (a power of two would
# use but a part of it).
_CHUNK = 2000
# Which bands see a line is looked up on this grid of ln(lambda); air moves lines by 3e-4.
_CELL, _AIR = 0.01, 1e-3


@dataclass(frozen=True, slots=True)
class LineGrid:
    """The line tables of all bands in one, see kernels.add_up; wavelengths of the lines."""

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
    """Tables of galaxies in some bands, memory-mapped.

    settings, tables : of each band;  reference : table of the reference band
    milky_way        : A(lambda) / A(V) on passbands.grid()
    """

    settings: tuple[Setting, ...]
    tables: tuple[Float32, ...]
    reference: Float32
    lines: LineGrid
    milky_way: Float


def open_grid(bands: Sequence[Passband], settings: Sequence[Setting], library: Library) -> Grid:
    """The tables of bands, each with its setting, for a library of galaxies; half a second a band to make."""
    key = build_tables.library_key(library)
    return Grid(
        tuple(settings),
        tuple(build_tables.galaxy_table(b, library, s, key) for b, s in zip(bands, settings, strict=True)),
        build_tables.galaxy_table(passbands.load(REFERENCE_BAND), library, REFERENCE_SETTING, key),
        _line_grid(bands),
        extinction.milky_way(passbands.grid()),
    )


def galaxy_fluxes(rows: Galaxies, grid: Grid) -> Float:
    """f_nu, float64[n, n_band] microjansky, of galaxies that are `covered`: what integration.galaxies gives.

    Error: as measured of each setting in each band (flux_errors.csv)
    """
    # Neighbours in redshift read the same part of a table.
    # 16 bits of it are enough, and sorted ten times faster.
    span = 65_535.0 / np.log1p(Z_LAST - Z_FIRST)
    order = np.argsort((np.log1p(np.maximum(rows.mix.z_obs - Z_FIRST, 0.0)) * span).astype(np.uint16), kind="stable")
    out = np.empty((len(rows), len(grid.tables)))
    for start in range(0, len(rows), _CHUNK):
        indices = order[start : start + _CHUNK]
        _fill_chunk(rows.select(indices), grid, indices, out)
    return out


def _fill_chunk(rows: Galaxies, grid: Grid, indices: Int, out: Float) -> None:
    """Fills out[part]."""
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
    """Compile, by computing one galaxy."""
    ones, zeros = np.ones(1), np.zeros((2, 1))
    mix = TemplateMix(ones, zeros.astype(np.int64), zeros.astype(np.int64), zeros + 0.5, zeros)
    galaxy_fluxes(
        Galaxies(mix, -20.0 * ones, 20.0 * ones, np.full((1, len(lines.line_list())), 1e-17), ones, ones), grid
    )


def star_fluxes(rows: Stars, bands: Sequence[Passband], library: Library) -> Float:
    """f_nu, float64[n, n_band] microjansky, of stars that are covered: what integration.stars gives, within 1e-6."""
    key = build_tables.library_key(library)
    basis = build_tables.chebyshev(rows.a_v, STAR_A_V_LAST, build_tables.STAR_COEFFICIENTS)
    scale = star_scale(rows, library)
    f_nu = np.empty((len(bands), len(rows)))
    for k, band in enumerate(bands):
        table = build_tables.star_table(band, library, key)
        kernels.mix_stars(table, rows.sed, rows.frac, basis, scale, f_nu[k])
    return units.ujy_of_cgs(f_nu).T


def covered_galaxies(rows: Galaxies) -> Bool:
    """Which galaxies the tables cover, bool[n]; a component without flux, or without a law, may have any E(B-V)."""
    mix = rows.mix
    dusty = (mix.ebv > EBV_LAST) & (mix.law > 0) & (mix.frac > 0.0)
    in_range = (mix.z_obs >= Z_FIRST) & (mix.z_obs <= Z_LAST)
    return np.asarray(in_range & ~dusty.any(0) & (rows.a_v <= A_V_LAST))


def covered_stars(rows: Stars) -> Bool:
    """Which stars the tables cover, bool[n]."""
    return np.asarray(rows.a_v <= STAR_A_V_LAST)


def _component_ratios(
    mix: TemplateMix, log_z: Float, a_v: Float, settings: Sequence[Setting], tables: Sequence[Float32]
) -> Float32:
    """f_nu of each component in each band relative to the reference band at rest: float32[n_band, 2, n]."""
    # Most bands share their nodes, or their polynomials, with another.
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
