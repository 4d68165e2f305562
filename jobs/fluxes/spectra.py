"""Spectra of galaxies and stars as they reach the telescope, and what they give through passbands.

galaxy_spectra   combined, extinguished, redshifted, scaled, with lines, magnified, behind the Milky Way
star_spectra     scaled to H, behind the dust on the way
band_fluxes      f_nu of any of them
galaxy_fluxes    table `galaxies` -> table `galaxy_fluxes`
star_fluxes      table `stars` -> table `star_fluxes`

Spectra are on the grid of passbands.grid(), 600 .. 24000 A by 1 A. The flux tables are the same sums, over
the wavelengths of the wanted bands only (jobs/fluxes/integration.py).
Ref: Serrano et al. 2024, appendix B, in its order
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from jobs.fluxes import extinction, integration, lines, passbands
from jobs.fluxes.calibration import continuum_scale, star_scale
from jobs.fluxes.continuum import REFERENCE_BAND, amplitudes, dust_of, observed_shape
from jobs.fluxes.passbands import Passband
from jobs.fluxes.sources import galaxies_of, stars_of
from jobs.fluxes.templates import Library
from lake_schema import units
from lake_schema.errors import BadInput
from lake_schema.tables.fluxes import fluxes

Float = npt.NDArray[np.float64]

# Rows turned into arrays at a time: some 20 MB of them.
_SLICE = 50_000


def galaxy_spectra(galaxies: pa.Table, library: Library, medium: str = "vacuum") -> Float:
    """f_lambda of galaxies, float64[n, 23401] erg s-1 cm-2 A-1 (187 kB a row).

    galaxies : rows of the table `galaxies`
    medium   : where lines are seen, "vacuum" (from space) or "air" (from the ground)
    Error    : 1e-6 relative (the templates are held in single precision)
    """
    rows = galaxies_of(galaxies, library)
    grid = passbands.grid()
    if not len(rows):
        return np.zeros((0, len(grid)))
    reference, dust = passbands.load(REFERENCE_BAND), dust_of(library)
    amplitude = amplitudes(rows.mix, reference, library, dust)
    shape = observed_shape(rows.mix, amplitude, library, dust, passbands.GRID_FIRST, len(grid))
    spectra = shape.astype(float)
    inside = slice(reference.first, reference.first + len(reference.wavelength))
    observed = spectra[:, inside] @ passbands.weights(reference)
    spectra *= continuum_scale(rows.mag_r01, observed)[:, None]
    sigma = lines.velocity_dispersion(rows.abs_mag_r01, rows.mix.z_obs)
    found = lines.profiles(rows.lines, rows.mix.z_obs, sigma, medium)
    lines.add(spectra, passbands.GRID_FIRST, found)
    spectra *= rows.magnification[:, None]
    spectra *= milky_way_transmission(grid, rows.a_v)
    return spectra


def star_spectra(stars: pa.Table, library: Library) -> Float:
    """f_lambda of stars, float64[n, 23401] erg s-1 cm-2 A-1; `stars`: rows of the table `stars`."""
    rows = stars_of(stars, library)
    spectra = library.flux[rows.sed].astype(float) * star_scale(rows, library)[:, None]
    return np.asarray(spectra * milky_way_transmission(library.wavelength, rows.a_v))


def band_fluxes(spectra: Float, bands: Sequence[Passband]) -> Float:
    """Band-averaged f_nu, float64[n, n_band] microjansky, of spectra [n, 23401] on the grid."""
    out = np.empty((len(spectra), len(bands)))
    for k, band in enumerate(bands):
        out[:, k] = spectra[:, band.first : band.first + len(band.wavelength)] @ passbands.weights(band)
    return units.ujy_of_cgs(out)


def galaxy_fluxes(galaxies: pa.Table, bands: Sequence[str], library: Library) -> pa.Table:
    """f_nu of galaxies through bands: internal dust, lines, magnification and the Milky Way's dust included.

    galaxies : rows of the table `galaxies`;  bands : names of passbands
    returns  : rows of the table `galaxy_fluxes` in the same order, microjansky
    Error    : 1e-6 relative to band_fluxes of galaxy_spectra
    Errors   : BadInput names the column and source of a missing value, OutOfRange what is out of bounds
    """
    curves = [passbands.load(name) for name in bands]
    f_nu = [integration.galaxies(galaxies_of(part, library), curves, library) for part in _slices(galaxies)]
    return _table("galaxy", galaxies, bands, np.concatenate(f_nu))


def star_fluxes(stars: pa.Table, bands: Sequence[str], library: Library) -> pa.Table:
    """f_nu of stars through bands, with the dust on the way to each; as `galaxy_fluxes`."""
    curves = [passbands.load(name) for name in bands]
    f_nu = [integration.stars(stars_of(part, library), curves, library) for part in _slices(stars)]
    return _table("star", stars, bands, np.concatenate(f_nu))


def milky_way_transmission(wavelength: npt.ArrayLike, a_v: Float) -> Float:
    """10^(-0.4 A(lambda)), float64[n, n_lambda]: A = R_V E(B-V) [A(lambda) / A(V)], a_v = R_V E(B-V)."""
    return np.asarray(extinction.transmitted(extinction.milky_way(wavelength), a_v[:, None]))


def _slices(table: pa.Table) -> list[pa.Table]:
    return [table.slice(start, _SLICE) for start in range(0, max(table.num_rows, 1), _SLICE)]


def _table(kind: str, source: pa.Table, bands: Sequence[str], f_nu: Float) -> pa.Table:
    names = ("id", "ra", "dec", "_healpix_29")
    if absent := [name for name in names if name not in source.column_names]:
        raise BadInput(f"{kind} catalogue: column {', '.join(absent)} is missing")
    positions = {name: source[name] for name in names}
    columns = {f"f_nu_{band}": f_nu[:, k].astype(np.float32) for k, band in enumerate(bands)}
    return fluxes(kind, bands).build(positions | columns)
