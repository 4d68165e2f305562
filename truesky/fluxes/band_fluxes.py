"""Spectra of galaxies and stars as they reach the telescope, and what they give through passbands.

galaxy_spectra   combined, extinguished, redshifted, scaled, with lines, magnified, behind the Milky Way
star_spectra     scaled to H, behind the dust on the way
band_fluxes      f_nu of any of them
galaxy_fluxes    table `galaxies` -> table `galaxy_fluxes`
star_fluxes      table `stars` -> table `star_fluxes`
galaxy_fluxes_by the same with chosen settings of the tables
prepare          make the tables that the two need, and compile

Spectra are on the grid of passbands.grid(), 600 .. 24000 A by 1 A. The flux tables are the same sums, interpolated in
tables (tables/flux_tables.py) where the accuracy allows it, else over the wavelengths of the wanted bands
(integration.py).
Ref: Serrano et al. 2024, appendix B, in its order
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from lake_schema import units
from lake_schema.arrays import Bool, Float, Int
from lake_schema.errors import BadInput
from lake_schema.tables.fluxes import fluxes
from truesky.fluxes import high_redshift, integration, passbands
from truesky.fluxes.calibration import continuum_scale, star_scale
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.passbands import Passband
from truesky.fluxes.sources import GALAXY_KINDS, Galaxies, Stars, galaxies_from_table, stars_from_table
from truesky.fluxes.spectra import extinction, lines
from truesky.fluxes.spectra.continuum import REFERENCE_BAND, amplitudes, dust_curves, observed_shape
from truesky.fluxes.tables import errors_measured, flux_tables
from truesky.fluxes.tables.build_tables import Setting
from truesky.fluxes.tables.settings import stars_tabulated
from truesky.numerics import matrices
from truesky.request.accuracy import REFERENCE, Accuracy

# Rows turned into arrays at a time: some 80 MB of them. The more, the more often a part of a table is used.
_SLICE = 200_000


def galaxy_spectra(galaxies: pa.Table, library: Library, medium: str = "vacuum") -> Float:
    """f_lambda of galaxies, float64[n, 23401] erg s-1 cm-2 A-1 (187 kB a row).

    galaxies : rows of the table `galaxies`
    medium   : where lines are seen, "vacuum" (from space) or "air" (from the ground)
    Error    : 1e-6 relative (the templates are held in single precision)
    """
    rows = galaxies_from_table(galaxies, library)
    grid = passbands.grid()
    if not len(rows):
        return np.zeros((0, len(grid)))
    reference, dust = passbands.load(REFERENCE_BAND), dust_curves(library)
    amplitude = amplitudes(rows.mix, reference, library, dust)
    shape = observed_shape(rows.mix, amplitude, library, dust, passbands.GRID_FIRST, len(grid))
    spectra = shape.astype(float)
    in_band = slice(reference.first, reference.first + len(reference.wavelength))
    observed = matrices.matmul(spectra[:, in_band], passbands.weights(reference))
    spectra *= continuum_scale(rows.mag_r01, observed)[:, None]
    sigma = lines.velocity_dispersion(rows.abs_mag_r01, rows.mix.z_obs)
    profiles = lines.profiles(rows.lines, rows.mix.z_obs, sigma, medium)
    lines.add(spectra, passbands.GRID_FIRST, profiles)
    spectra *= rows.magnification[:, None]
    spectra *= milky_way_transmission(grid, rows.a_v)
    return spectra


def star_spectra(stars: pa.Table, library: Library) -> Float:
    """f_lambda of stars, float64[n, 23401] erg s-1 cm-2 A-1; `stars`: rows of the table `stars`."""
    rows = stars_from_table(stars, library)
    spectra = np.zeros((len(rows), len(library.wavelength)))
    for sed, share in zip(rows.sed, rows.frac, strict=True):
        spectra += library.flux[sed] * share[:, None]
    spectra *= star_scale(rows, library)[:, None]
    return np.asarray(spectra * milky_way_transmission(library.wavelength, rows.a_v))


def band_fluxes(spectra: Float, bands: Sequence[Passband]) -> Float:
    """Band-averaged f_nu, float64[n, n_band] microjansky, of spectra [n, 23401] on the grid."""
    out = np.empty((len(spectra), len(bands)))
    for k, band in enumerate(bands):
        inside = slice(band.first, band.first + len(band.wavelength))
        out[:, k] = matrices.matmul(spectra[:, inside], passbands.weights(band))
    return units.ujy_of_cgs(out)


def galaxy_fluxes(
    galaxies: pa.Table, bands: Sequence[str | Passband], library: Library, accuracy: Accuracy = REFERENCE
) -> pa.Table:
    """f_nu of galaxies through bands: internal dust, lines, magnification and the Milky Way's dust included.

    galaxies : rows of the table `galaxies`, of any kind;  bands : names of passbands, or a user's own
    library  : of the kinds central, satellite and strong lens
    returns  : rows of the table `galaxy_fluxes` in the same order, microjansky
    Error    : |df/f| <= accuracy.flux against band_fluxes of galaxy_spectra (benchmarks/fluxes.py); 1e-6 at best
    Errors   : BadInput names the column and source of a missing value, OutOfRange what is out of bounds
    """
    curves = _load_passbands(bands)
    settings = [choice.setting for choice in errors_measured.choose(curves, accuracy, library)]
    return fluxes_with_settings(galaxies, curves, settings, library)


def fluxes_with_settings(
    galaxies: pa.Table, curves: Sequence[Passband], settings: Sequence[Setting | None], library: Library
) -> pa.Table:
    """`galaxy_fluxes` from the tables of these settings; bands without one are integrated.

    galaxies : rows of table `galaxies`;  curves, settings : passbands, and how fine the table of each is
    library  : templates of galaxies
    """
    tabulated = [k for k, setting in enumerate(settings) if setting is not None]
    grid = None
    f_nu, integrated = np.zeros((galaxies.num_rows, len(curves))), np.ones(galaxies.num_rows, bool)
    for start, chunk in _slices(galaxies):
        out, exact = (array[start : start + chunk.num_rows] for array in (f_nu, integrated))
        in_library = np.isin(_source_kinds(chunk), GALAXY_KINDS)
        if not in_library.all():
            out[~in_library] = high_redshift.fluxes(chunk.filter(pa.array(~in_library)), curves)
            chunk = chunk.filter(pa.array(in_library))
        rows = galaxies_from_table(chunk, library)
        if tabulated and grid is None and len(rows):
            grid_settings = [setting for setting in settings if setting is not None]
            grid = flux_tables.open_grid([curves[k] for k in tabulated], grid_settings, library)
        out[in_library], exact[in_library] = _galaxy_f_nu(rows, curves, tabulated, grid, library)
    return _flux_table("galaxy", galaxies, [curve.name for curve in curves], f_nu, integrated)


def star_fluxes(
    stars: pa.Table, bands: Sequence[str | Passband], library: Library, accuracy: Accuracy = REFERENCE
) -> pa.Table:
    """f_nu of stars through bands, with the dust on the way to each; as `galaxy_fluxes`.

    stars   : rows of table `stars`;  bands : embedded ones by name
    library : spectra of stars;  accuracy : largest errors that are allowed
    """
    curves = _load_passbands(bands)
    tabulated = stars_tabulated(accuracy)
    f_nu, integrated = np.zeros((stars.num_rows, len(curves))), np.ones(stars.num_rows, bool)
    for start, chunk in _slices(stars):
        chunk_rows = slice(start, start + chunk.num_rows)
        f_nu[chunk_rows], integrated[chunk_rows] = _star_f_nu(
            stars_from_table(chunk, library), curves, tabulated, library
        )
    return _flux_table("star", stars, [curve.name for curve in curves], f_nu, integrated)


def prepare(
    curves: Sequence[Passband],
    settings: Sequence[Setting | None],
    galaxy_library: Library,
    star_library: Library,
    accuracy: Accuracy,
) -> None:
    """Make what the cache lacks for these bands, tables and machine code, so that workers find it there.

    library, stars : of galaxies, of stars
    curves, settings : passbands, and how fine the table of each is; None: it is integrated
    accuracy         : largest errors that are allowed
    """
    tabulated = [(curve, setting) for curve, setting in zip(curves, settings, strict=True) if setting is not None]
    if tabulated:
        grid = flux_tables.open_grid(
            [curve for curve, _ in tabulated], [setting for _, setting in tabulated], galaxy_library
        )
        flux_tables.compile_kernels(grid)
    if stars_tabulated(accuracy):
        flux_tables.star_fluxes(
            Stars.from_templates(np.zeros(1, np.int64), np.zeros(1), np.zeros(1)), curves, star_library
        )


def _galaxy_f_nu(
    rows: Galaxies,
    curves: Sequence[Passband],
    tabulated: Sequence[int],
    grid: flux_tables.Grid | None,
    library: Library,
) -> tuple[Float, Bool]:
    """float64[n, n_band]: from tables where there are any, the rest integrated; bool[n] in no table."""
    if grid is None:
        return integration.galaxy_fluxes(rows, curves, library), np.ones(len(rows), bool)
    inside = flux_tables.covered_galaxies(rows)
    if inside.all() and len(tabulated) == len(curves):
        return flux_tables.galaxy_fluxes(rows, grid), ~inside
    out = np.zeros((len(rows), len(curves)))
    inside_rows, outside_rows = np.flatnonzero(inside), np.flatnonzero(~inside)
    covered = rows.select(inside_rows)
    out[np.ix_(inside_rows, np.array(tabulated))] = flux_tables.galaxy_fluxes(covered, grid)
    integrated_bands = [k for k in range(len(curves)) if k not in tabulated]
    if integrated_bands and len(inside_rows):
        out[np.ix_(inside_rows, np.array(integrated_bands))] = integration.galaxy_fluxes(
            covered, [curves[k] for k in integrated_bands], library
        )
    if len(outside_rows):
        out[outside_rows] = integration.galaxy_fluxes(rows.select(outside_rows), curves, library)
    return out, ~inside


def _star_f_nu(rows: Stars, curves: Sequence[Passband], tabulated: bool, library: Library) -> tuple[Float, Bool]:
    inside = flux_tables.covered_stars(rows) & tabulated
    out = np.zeros((len(rows), len(curves)))
    inside_rows, outside_rows = np.flatnonzero(inside), np.flatnonzero(~inside)
    if len(inside_rows):
        out[inside_rows] = flux_tables.star_fluxes(rows.select(inside_rows), curves, library)
    if len(outside_rows):
        out[outside_rows] = integration.star_fluxes(rows.select(outside_rows), curves, library)
    return out, ~inside


def milky_way_transmission(wavelength: npt.ArrayLike, a_v: Float) -> Float:
    """10^(-0.4 A(lambda)), float64[n, n_lambda]: A = R_V E(B-V) [A(lambda) / A(V)], a_v = R_V E(B-V)."""
    return np.asarray(extinction.transmission(extinction.milky_way(wavelength), a_v[:, None]))


def _load_passbands(bands: Sequence[str | Passband]) -> list[Passband]:
    if not bands:
        raise BadInput("no passband is asked for")
    return [band if isinstance(band, Passband) else passbands.load(band) for band in bands]


def _source_kinds(table: pa.Table) -> Int:
    if "kind" not in table.column_names:
        return np.zeros(table.num_rows, np.int64)
    return np.asarray(table["kind"].to_numpy(), np.int64)


def _slices(table: pa.Table) -> list[tuple[int, pa.Table]]:
    return [(start, table.slice(start, _SLICE)) for start in range(0, table.num_rows, _SLICE)]


def _flux_table(kind: str, source: pa.Table, bands: Sequence[str], f_nu: Float, integrated: Bool) -> pa.Table:
    names = ("id", "ra", "dec", "_healpix_29")
    if absent := [name for name in names if name not in source.column_names]:
        raise BadInput(f"{kind} catalogue: column {', '.join(absent)} is missing")
    columns = {name: source[name] for name in names}
    columns |= {f"f_nu_{band}": f_nu[:, k].astype(np.float32) for k, band in enumerate(bands)}
    return fluxes(kind, bands).build(columns | {"integrated": integrated})
