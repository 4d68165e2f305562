"""Compute spectra of galaxies and stars as they reach the telescope, and their fluxes in passbands.

Spectra are on the grid of passbands.grid(), 600 to 24000 A in steps of 1 A. Fluxes are interpolated in precomputed
tables (tables/flux_tables.py) if the requested accuracy permits it. Otherwise they are integrated over wavelength in
the requested bands (integration.py), which gives the same results as whole spectra.

References
----------
Serrano et al. 2024, appendix B. Dust, lines, magnification and other effects are applied in the order of this appendix.
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

# Number of sources in a slice. Sources are converted to arrays slice by slice, about 80 MB each, and sorted by redshift
# within a slice. With larger slices, each part of a flux table is read less often from memory.
_SLICE = 200_000


def galaxy_spectra(galaxies: pa.Table, library: Library, medium: str = "vacuum") -> Float:
    """Return the spectra of galaxies with dust, redshift, emission lines, magnification and Milky Way extinction.

    Parameters
    ----------
    galaxies : pa.Table
        Rows of the table `galaxies` with `kind` 0, 1 or 4 (central, satellite, strong lens).
    library : Library
        Templates of galaxies.
    medium : str, optional
        Medium in which lines are observed, "vacuum" (from space) or "air" (from the ground).

    Returns
    -------
    float array, shape (n, 23401)
        f_lambda in erg s-1 cm-2 A-1 at 600 to 24000 A (187 kB per galaxy).

    Raises
    ------
    BadInput
        If a value is missing, `kind` is another number, or the medium is unknown.
    OutOfRange
        If a value is out of range.

    Notes
    -----
    The relative error is 1e-6, because templates are stored in single precision.
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
    """Return the spectra of stars, dimmed by the dust in front of each star.

    Parameters
    ----------
    stars : pa.Table
        Rows of the table `stars`.
    library : Library
        Templates of stars.

    Returns
    -------
    float array, shape (n, 23401)
        f_lambda in erg s-1 cm-2 A-1 at 600 to 24000 A.

    Raises
    ------
    BadInput
        If a value is missing.
    OutOfRange
        If a value is out of range.
    """
    rows = stars_from_table(stars, library)
    spectra = np.zeros((len(rows), len(library.wavelength)))
    for sed, share in zip(rows.sed, rows.frac, strict=True):
        spectra += library.flux[sed] * share[:, None]
    spectra *= star_scale(rows, library)[:, None]
    return np.asarray(spectra * milky_way_transmission(library.wavelength, rows.a_v))


def band_fluxes(spectra: Float, bands: Sequence[Passband]) -> Float:
    """Return the band-averaged f_nu of spectra.

    Parameters
    ----------
    spectra : float array, shape (n, 23401)
        f_lambda on passbands.grid() in erg s-1 cm-2 A-1.
    bands : sequence of Passband
        The passbands.

    Returns
    -------
    float array, shape (n, n_band)
        f_nu in microjansky.
    """
    out = np.empty((len(spectra), len(bands)))
    for k, band in enumerate(bands):
        inside = slice(band.first, band.first + len(band.wavelength))
        out[:, k] = matrices.matmul(spectra[:, inside], passbands.weights(band))
    return units.ujy_of_cgs(out)


def galaxy_fluxes(
    galaxies: pa.Table, bands: Sequence[str | Passband], library: Library, accuracy: Accuracy = REFERENCE
) -> pa.Table:
    """Return the fluxes of galaxies in passbands with internal dust, lines, magnification and Milky Way extinction.

    Parameters
    ----------
    galaxies : pa.Table
        Rows of the table `galaxies` of any `kind`, also quasars and high-redshift galaxies. Columns id, ra, dec and
        _healpix_29 are copied to the result.
    bands : sequence of str or Passband
        At least one passband: names of built-in ones, or Passband objects.
    library : Library
        Templates of galaxies with `kind` 0, 1 or 4 (central, satellite, strong lens).
    accuracy : Accuracy, optional
        Errors that are allowed. By default they are so small that all fluxes are integrated.

    Returns
    -------
    pa.Table
        Rows of the table `galaxy_fluxes` in the same order: f_nu in microjansky in one column per band.

    Raises
    ------
    BadInput
        If there is no band, a name is unknown, a band is not inside 600 to 24000 A, or a value is missing. The message
        names the band, or the column and the source.
    OutOfRange
        If a value is out of range.

    Notes
    -----
    The relative error is at most `accuracy.flux`, compared with `band_fluxes` of `galaxy_spectra`
    (benchmarks/fluxes.py). It is 1e-6 at best. In a narrow band that dust of the galaxy and of the Milky
    Way dims by more than 5 mag, it is 2e-7 per magnitude, because exponents have single precision.
    """
    curves = _load_passbands(bands)
    settings = [choice.setting for choice in errors_measured.choose(curves, accuracy, library)]
    return fluxes_with_settings(galaxies, curves, settings, library)


def fluxes_with_settings(
    galaxies: pa.Table, curves: Sequence[Passband], settings: Sequence[Setting | None], library: Library
) -> pa.Table:
    """Return the fluxes of galaxies like `galaxy_fluxes`, from flux tables of the given resolutions.

    Parameters
    ----------
    galaxies : pa.Table
        Rows of the table `galaxies`.
    curves : sequence of Passband
        The passbands.
    settings : sequence of Setting or None
        Resolution of the flux table of each passband. Fluxes in passbands with None are integrated.
    library : Library
        Templates of galaxies.

    Returns
    -------
    pa.Table
        Rows of the table `galaxy_fluxes` in the same order, with f_nu in microjansky. Their column `integrated` is true
        for galaxies outside the ranges of the flux tables, for quasars and high-redshift galaxies, and for all galaxies
        if no passband has a table.
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
    """Return the fluxes of stars in passbands, dimmed by the dust in front of each star.

    Parameters
    ----------
    stars : pa.Table
        Rows of the table `stars`. Columns id, ra, dec and _healpix_29 are copied to the result.
    bands : sequence of str or Passband
        At least one passband: names of built-in ones, or Passband objects.
    library : Library
        Templates of stars.
    accuracy : Accuracy, optional
        Errors that are allowed. By default they are so small that all fluxes are integrated.

    Returns
    -------
    pa.Table
        Rows of the table `star_fluxes` in the same order: f_nu in microjansky in one column per band. The column
        `integrated` is true for stars whose fluxes are not from flux tables.

    Raises
    ------
    BadInput
        If there is no band, a name is unknown, or a value is missing.
    OutOfRange
        If a value is out of range.
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
    """Compute the flux tables and machine code for some bands and write them to the cache on disc.

    Worker processes then load them instead of computing them at the same time.

    Parameters
    ----------
    curves : sequence of Passband
        The passbands.
    settings : sequence of Setting or None
        Resolution of the flux table of each passband for galaxies; None for passbands that are integrated.
    galaxy_library, star_library : Library
        Templates of galaxies and of stars.
    accuracy : Accuracy
        Errors that the user allows. They decide whether fluxes of stars come from tables.
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
    """Return f_nu (microjansky), float64[n, n_band], and True for galaxies whose fluxes are all integrated, bool[n].

    `tabulated` has the indices of the bands in the flux tables `grid`. Other bands, and galaxies outside the ranges of
    the tables, are integrated; all are if `grid` is None.
    """
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
    """Return the transmission of the Milky Way's dust, 10^(-0.4 A(lambda)).

    Parameters
    ----------
    wavelength : float array, shape (n_lambda,)
        Wavelengths in A.
    a_v : float array, shape (n,)
        Extinction A(V) = 3.1 E(B-V) towards each source in mag.

    Returns
    -------
    float array, shape (n, n_lambda)
        Transmission from 0 to 1 (above 1 if A(V) is negative).
    """
    return np.asarray(extinction.transmission(extinction.milky_way(wavelength), a_v[:, None]))


def _load_passbands(bands: Sequence[str | Passband]) -> list[Passband]:
    if not bands:
        raise BadInput("passbands: at least one is required")
    curves = [band if isinstance(band, Passband) else passbands.load(band) for band in bands]
    for curve in curves:
        # Wavelengths outside the grid would have indices of other wavelengths, or none.
        if not passbands.GRID_FIRST <= curve.wavelength[0] <= curve.wavelength[-1] <= passbands.GRID_LAST:
            ends = f"{curve.wavelength[0]:g} to {curve.wavelength[-1]:g} A"
            allowed = f"must be inside {passbands.GRID_FIRST} to {passbands.GRID_LAST} A"
            raise BadInput(f"passband {curve.name}: {ends}, {allowed}")
    return curves


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
