"""Spectra of the sources of a detector over a passband: what is spread out by a grism.

of_rows    a function of the sources' numbers
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Float, Float32, Int
from truesky.fluxes import high_redshift, stretches
from truesky.fluxes.libraries import templates
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.passbands import Passband
from truesky.fluxes.sources import GALAXY_KINDS, galaxies_of, stars_of
from truesky.numerics import sums
from truesky.render.sources import colours

Spectra = Callable[[Int], Float32]


def of_rows(
    which: Int, galaxies: pa.Table, stars: pa.Table, band: Passband, sun: Float,
    libraries: tuple[Library | None, Library | None] = (None, None),
) -> Spectra:  # fmt: skip
    """(numbers of sources [k]) -> float32[k, w] f_lambda of each over the band, of which it detects one photon.

    So it is as bright as the table of fluxes has it, whatever that says.  Whose spectrum the tables do not hold has
    flat f_nu.
    which     : int[n] row of each source's spectrum, counted from the galaxies on to the stars; -1 = the Sun's
    galaxies, stars : rows of the catalogues;  band : passband;  sun : float64[w] the Sun's f_lambda, on any scale
    libraries : what the galaxies' templates count, and the stars'; None = the embedded ones
    """
    count, weights = len(band.wavelength), band.response * band.wavelength
    of_galaxy, of_star = _galaxies(galaxies, band, libraries[0]), _stars(stars, band, libraries[1])

    def of(some: Int) -> Float32:
        rows, out = which[some], np.empty((len(some), count), np.float32)
        galaxy, star = (rows >= 0) & (rows < len(galaxies)), rows >= len(galaxies)
        if galaxy.any():
            out[galaxy] = of_galaxy(rows[galaxy])
        if star.any():
            out[star] = of_star(rows[star] - len(galaxies))
        out[rows < 0] = sun
        detected = sums.product(out, weights)
        out *= np.divide(1.0, detected, out=np.zeros(len(some)), where=detected > 0.0).astype(np.float32)[:, None]
        return out

    return of


def _flat(band: Passband) -> Spectra:
    flat = (band.wavelength[0] / band.wavelength) ** 2
    return lambda some: np.tile(flat.astype(np.float32), (len(some), 1))


def _galaxies(rows: pa.Table, band: Passband, library: Library | None) -> Spectra:
    if not len(rows) or not set(colours.GALAXY_COLUMNS) <= set(rows.column_names):
        return _flat(band)
    first, count, library = int(band.wavelength[0]), len(band.wavelength), library or templates.galaxy_library()
    kinds = rows["kind"].to_numpy() if "kind" in rows.column_names else np.full(len(rows), GALAXY_KINDS[0])
    usual = np.isin(kinds, GALAXY_KINDS)
    found, row = galaxies_of(rows.filter(pa.array(usual)), library), np.cumsum(usual) - 1

    def of(some: Int) -> Float32:
        out = np.empty((len(some), count), np.float32)
        own = usual[some]
        if own.any():
            out[own] = stretches.galaxies(found.rows(row[some[own]]), first, count, library)
        if not own.all():
            out[~own] = high_redshift.spectra(rows.take(some[~own]))[:, band.first : band.first + count]
        return out

    return of


def _stars(rows: pa.Table, band: Passband, library: Library | None) -> Spectra:
    if not len(rows) or not set(colours.OF_ONE_TEMPLATE) <= set(rows.column_names):
        return _flat(band)
    library = library or templates.stellar_library()
    found = stars_of(rows, library)
    return lambda some: stretches.stars(found.rows(some), int(band.wavelength[0]), len(band.wavelength), library)
