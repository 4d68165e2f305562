"""Compute the spectra of galaxies, stars and Solar System bodies over a passband, for images through a grism."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Float, Float32, Int
from truesky.fluxes import high_redshift, wavelength_windows
from truesky.fluxes.libraries import templates
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.passbands import Passband
from truesky.fluxes.sources import GALAXY_KINDS, galaxies_from_table, stars_from_table
from truesky.numerics import matrices
from truesky.render.sources import colours
from truesky.render.sources.point_light import OwnSpectra

# Function (indices of k sources) -> their spectra over the passband, shape (k, wavelengths).
Spectra = Callable[[Int], Float32]


def spectrum_function(
    spectrum_rows: Int, galaxies: pa.Table, stars: pa.Table, band: Passband, sun: Float,
    libraries: tuple[Library | None, Library | None] = (None, None), own_spectra: OwnSpectra | None = None,
) -> Spectra:  # fmt: skip
    """Return a function that computes the spectra of sources over a band.

    Parameters
    ----------
    spectrum_rows : int array, shape (n,)
        Row that has the spectrum of each of the n sources, in the list of all galaxies followed by all stars; -1 for
        the spectrum of the Sun (Solar System bodies).
    galaxies, stars : pyarrow.Table
        Rows of the tables `galaxies` and `stars`.
    band : Passband
        Response of the band at w wavelengths.
    sun : float array, shape (w,)
        f_lambda of the Sun at these wavelengths, on any scale.
    libraries : (Library or None, Library or None)
        Libraries of spectral templates to which the rows of galaxies and stars refer; None means the library of
        truesky.
    own_spectra : OwnSpectra, optional
        Spectra of the last stars, instead of their templates.

    Returns
    -------
    callable
        Function (indices of k sources, int array) -> f_lambda over the band, float32 array of shape (k, w). Each
        spectrum is scaled so that the band detects one photon; a spectrum without light in the band is 0.

    Notes
    -----
    The brightness of sources comes from the tables of fluxes, hence the scaling. If a table lacks the columns of
    spectra, its sources have flat f_nu.
    """
    count, weights = len(band.wavelength), band.response * band.wavelength
    of_galaxy, of_star = _galaxies(galaxies, band, libraries[0]), _stars(stars, band, libraries[1])
    last_rows = len(galaxies) + len(stars) - (0 if own_spectra is None else own_spectra.count)

    def spectra_of_sources(numbers: Int) -> Float32:
        rows, out = spectrum_rows[numbers], np.empty((len(numbers), count), np.float32)
        galaxy, star = (rows >= 0) & (rows < len(galaxies)), rows >= len(galaxies)
        if galaxy.any():
            out[galaxy] = of_galaxy(rows[galaxy])
        if star.any():
            out[star] = of_star(rows[star] - len(galaxies))
        out[rows < 0] = sun
        if own_spectra is not None:
            has_own_spectrum = rows >= last_rows
            # Scale by the largest value, because f_lambda in cgs units is close to the smallest float32.
            spectra = own_spectra.compute(rows[has_own_spectrum] - last_rows)
            out[has_own_spectrum] = spectra / np.maximum(spectra.max(axis=1, keepdims=True), np.finfo(float).tiny)
        detected = matrices.matmul(out, weights)
        out *= np.divide(1.0, detected, out=np.zeros(len(numbers)), where=detected > 0.0).astype(np.float32)[:, None]
        return out

    return spectra_of_sources


def _flat(band: Passband) -> Spectra:
    flat = (band.wavelength[0] / band.wavelength) ** 2
    return lambda some: np.tile(flat.astype(np.float32), (len(some), 1))


def _galaxies(rows: pa.Table, band: Passband, library: Library | None) -> Spectra:
    if not len(rows) or not set(colours.GALAXY_COLUMNS) <= set(rows.column_names):
        return _flat(band)
    first, count, library = int(band.wavelength[0]), len(band.wavelength), library or templates.galaxy_library()
    galaxy_kinds = rows["kind"].to_numpy() if "kind" in rows.column_names else np.full(len(rows), GALAXY_KINDS[0])
    in_library = np.isin(galaxy_kinds, GALAXY_KINDS)
    parameters, row = galaxies_from_table(rows.filter(pa.array(in_library)), library), np.cumsum(in_library) - 1

    def spectra_of_rows(numbers: Int) -> Float32:
        out = np.empty((len(numbers), count), np.float32)
        from_library = in_library[numbers]
        if from_library.any():
            out[from_library] = wavelength_windows.galaxy_spectra(
                parameters.select(row[numbers[from_library]]), first, count, library
            )
        if not from_library.all():
            few = rows.take(numbers[~from_library])
            out[~from_library] = high_redshift.spectra(few, first, first + count - 1)
        return out

    return spectra_of_rows


def _stars(rows: pa.Table, band: Passband, library: Library | None) -> Spectra:
    if not len(rows) or not set(colours.ONE_TEMPLATE_COLUMNS) <= set(rows.column_names):
        return _flat(band)
    library = library or templates.stellar_library()
    parameters = stars_from_table(rows, library)
    return lambda some: wavelength_windows.star_spectra(
        parameters.select(some), int(band.wavelength[0]), len(band.wavelength), library
    )
