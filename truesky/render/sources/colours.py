"""Colours of sources within a band: fractions of their photons in the sub-bands of the PSF.

Sources without a spectrum in the table have flat f_nu.
"""

from __future__ import annotations

from collections.abc import Sequence

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
from truesky.render.psf import sub_bands
from truesky.render.psf.sub_bands import N_SUB_BANDS

# Resolution of the tables of f_nu by redshift and dust: an error of 1e-3 of a fraction is 1e-5 of the second moments.
_SETTING = Setting(0.01, 4, 3)
# Columns of the galaxy catalogue.
GALAXY_COLUMNS = (
    *("z_obs", "abs_mag_r01", "mag_r01", "a_v", "kappa", "gamma1", "gamma2"),
    *(f"{name}_{k}" for name in ("sed", "frac", "ext_law", "ebv") for k in COMPONENTS),
    *sorted({line.column for line in line_list()}),
)
# Columns that a star needs for a spectrum. User catalogues do not have a second template.
ONE_TEMPLATE_COLUMNS = ("sed", "mag_h", "a_v")
STAR_COLUMNS = (*ONE_TEMPLATE_COLUMNS, *(f"{name}_{k}" for k in STAR_COMPONENTS for name in ("sed", "frac")))


def galaxies(rows: pa.Table, band: Passband, library: Library | None = None) -> Float:
    """Fractions of the detected photons of galaxies by sub-band.

    Parameters
    ----------
    rows : pyarrow.Table
        Rows of the table `galaxies`.
    band : Passband
        The passband.
    library : Library, optional
        Library to which sed_1 and sed_2 refer; by default the embedded galaxies.

    Returns
    -------
    float array, shape (n, N_SUB_BANDS)
        Fractions, with an rms error of 1e-3 from the coarse tables, which is 1e-5 of the second moments.
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


def _library_fluxes(rows: pa.Table, parts: Sequence[Passband], library: Library) -> Float:
    """Values of f_nu for galaxies whose spectra are in the galaxy library."""
    parameters = galaxies_from_table(rows, library)
    tabulated = flux_tables.covered_galaxies(parameters)
    f_nu = np.empty((len(parameters), len(parts)))
    if tabulated.any():
        grid = flux_tables.open_grid(parts, (_SETTING,) * len(parts), library)
        f_nu[tabulated] = flux_tables.galaxy_fluxes(parameters.select(np.flatnonzero(tabulated)), grid)
    if not tabulated.all():
        f_nu[~tabulated] = integration.galaxy_fluxes(parameters.select(np.flatnonzero(~tabulated)), parts, library)
    return f_nu


def stars(rows: pa.Table, band: Passband, library: Library | None = None) -> Float:
    """Fractions of the detected photons of stars by sub-band.

    Parameters
    ----------
    rows : pyarrow.Table
        Rows of the table `stars`.
    band : Passband
        The passband.
    library : Library, optional
        Library to which the templates refer; by default the embedded stars.

    Returns
    -------
    float array, shape (n, N_SUB_BANDS)
        Fractions.
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
    """Fractions [N_SUB_BANDS] of the detected photons of a spectrum f_lambda at the band's wavelengths."""
    parts = sub_bands.sub_bands(band)
    f_nu = np.array([[passbands.ab_flux(part, band.wavelength, f_lambda) for part in parts]])
    return np.asarray(_shares(f_nu, parts)[0])


def _flat(n: int) -> Float:
    return np.full((n, N_SUB_BANDS), 1.0 / N_SUB_BANDS)


def _shares(f_nu: Float, parts: tuple[Passband, ...]) -> Float:
    photons = f_nu * np.array([passbands.log_width(part) for part in parts])
    total = photons.sum(axis=1, keepdims=True)
    return np.where(total > 0, photons / np.where(total > 0, total, 1.0), 1.0 / N_SUB_BANDS)
