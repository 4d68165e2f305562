"""Compute the colours of sources within a passband, on which the shape of their PSF depends.

A passband is divided into eight sub-bands in which the PSF is treated as constant. The colour of a source is the
fraction of its detected photons in each sub-band. Sources without a spectrum in their table have flat f_nu.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Float
from truesky.fluxes import high_redshift, integration, passbands
from truesky.fluxes.libraries import templates
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.passbands import Passband
from truesky.fluxes.sources import GALAXY_KINDS, STAR_COMPONENTS, galaxies_from_table, stars_from_table
from truesky.fluxes.spectra.continuum import COMPONENTS
from truesky.fluxes.spectra.lines import line_list
from truesky.fluxes.tables import flux_tables
from truesky.fluxes.tables.build_tables import Setting
from truesky.fluxes.tables.flux_tables import Grid
from truesky.numerics import matrices
from truesky.render.psf import sub_bands
from truesky.render.psf.sub_bands import N_SUB_BANDS

# Resolution of the tables of f_nu from which colours are interpolated: step in ln(1 + z), and numbers of Chebyshev
# coefficients in E(B-V) and in A(V). The fraction of photons in a sub-band has an error of 1e-3, which changes the
# second moments of the PSF by 1e-5.
_SETTING = Setting(0.01, 4, 3)
# Columns of the table `galaxies` that define spectra.
GALAXY_COLUMNS = (
    *("z_obs", "abs_mag_r01", "mag_r01", "a_v", "kappa", "gamma1", "gamma2"),
    *(f"{name}_{k}" for name in ("sed", "frac", "ext_law", "ebv") for k in COMPONENTS),
    *sorted({line.column for line in line_list()}),
)
# Columns of the table `stars` that define a spectrum by a single template. Stars from a user's catalogue have no other
# columns for spectra.
ONE_TEMPLATE_COLUMNS = ("sed", "mag_h", "a_v")
# Columns of the table `stars` that define spectra, including those that are mixtures of templates.
STAR_COLUMNS = (*ONE_TEMPLATE_COLUMNS, *(f"{name}_{k}" for k in STAR_COMPONENTS for name in ("sed", "frac")))


def galaxies(rows: pa.Table, band: Passband, library: Library | None = None) -> Float:
    """Return the fractions of the detected photons of galaxies in the sub-bands of a passband.

    Parameters
    ----------
    rows : pyarrow.Table
        n rows of the table `galaxies`.
    band : Passband
        Response of the band as a function of wavelength.
    library : Library, optional
        Library of spectral templates to which the columns sed_1 and sed_2 refer; None means the galaxies of truesky.

    Returns
    -------
    float array, shape (n, N_SUB_BANDS)
        Fractions, with the sum 1 for each galaxy and an rms error of 1e-3. They are equal (flat f_nu) if `rows` lacks
        columns of spectra, or for a galaxy without light in the band.
    """
    if not len(rows) or not set(GALAXY_COLUMNS) <= set(rows.column_names):
        return _flat(len(rows))
    parts = sub_bands.sub_bands(band)
    f_nu = np.empty((len(rows), len(parts)))
    in_library = (
        np.isin(rows["kind"].to_numpy(), GALAXY_KINDS) if "kind" in rows.column_names else np.ones(len(rows), bool)
    )
    if not in_library.all():
        f_nu[~in_library] = high_redshift.fluxes(rows.filter(pa.array(~in_library)), parts)
    f_nu[in_library] = _library_fluxes(rows.filter(pa.array(in_library)), parts, library or templates.galaxy_library())
    return _shares(f_nu, parts)


def _library_fluxes(rows: pa.Table, parts: tuple[Passband, ...], library: Library) -> Float:
    """Return f_nu in each sub-band for galaxies with templates in the library, shape (n, number of sub-bands).

    Values are interpolated in tables where these cover the parameters of a galaxy, otherwise integrated.
    """
    parameters = galaxies_from_table(rows, library)
    tabulated = flux_tables.covered_galaxies(parameters)
    f_nu = np.empty((len(parameters), len(parts)))
    if tabulated.any():
        grid = _grid(parts, library)
        f_nu[tabulated] = flux_tables.galaxy_fluxes(parameters.select(np.flatnonzero(tabulated)), grid)
    if not tabulated.all():
        f_nu[~tabulated] = integration.galaxy_fluxes(parameters.select(np.flatnonzero(~tabulated)), parts, library)
    return f_nu


@lru_cache(maxsize=4)
def _grid(parts: tuple[Passband, ...], library: Library) -> Grid:
    """Return the flux tables of sub-bands for a library of galaxies. They are mapped from the disc, not read."""
    return flux_tables.open_grid(parts, (_SETTING,) * len(parts), library)


def stars(rows: pa.Table, band: Passband, library: Library | None = None) -> Float:
    """Return the fractions of the detected photons of stars in the sub-bands of a passband.

    Parameters
    ----------
    rows : pyarrow.Table
        n rows of the table `stars`.
    band : Passband
        Response of the band as a function of wavelength.
    library : Library, optional
        Library of spectral templates to which the rows refer; None means the stars of truesky.

    Returns
    -------
    float array, shape (n, N_SUB_BANDS)
        Fractions, with the sum 1 for each star. They are equal (flat f_nu) if `rows` lacks columns of spectra, or for a
        star without light in the band.
    """
    if not len(rows) or not set(ONE_TEMPLATE_COLUMNS) <= set(rows.column_names):
        return _flat(len(rows))
    library, parts = library or templates.stellar_library(), sub_bands.sub_bands(band)
    parameters = stars_from_table(rows, library)
    tabulated = flux_tables.covered_stars(parameters)
    f_nu = np.empty((len(parameters), len(parts)))
    for chosen, kernel in ((tabulated, flux_tables.star_fluxes), (~tabulated, integration.star_fluxes)):
        if chosen.any():
            f_nu[chosen] = kernel(parameters.select(np.flatnonzero(chosen)), parts, library)
    return _shares(f_nu, parts)


def spectrum_fractions(band: Passband, f_lambda: Float) -> Float:
    """Return the fractions of the detected photons of spectra in the sub-bands of a band, shape (n, N_SUB_BANDS).

    `f_lambda`, shape (n, w), has the flux per wavelength at the w wavelengths of the band, in any unit.
    """
    parts = sub_bands.sub_bands(band)
    edges = np.cumsum([0, *(len(part.wavelength) for part in parts)])
    f_nu = [
        matrices.matmul(f_lambda[:, first:last], passbands.weights(part))
        for part, first, last in zip(parts, edges[:-1], edges[1:], strict=True)
    ]
    return _shares(np.stack(f_nu, axis=1), parts)


def _flat(n: int) -> Float:
    return np.full((n, N_SUB_BANDS), 1.0 / N_SUB_BANDS)


def _shares(f_nu: Float, parts: tuple[Passband, ...]) -> Float:
    photons = f_nu * np.array([passbands.log_width(part) for part in parts])
    total = photons.sum(axis=1, keepdims=True)
    return np.where(total > 0, photons / np.where(total > 0, total, 1.0), 1.0 / N_SUB_BANDS)
