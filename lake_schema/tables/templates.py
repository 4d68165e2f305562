"""Declaration of the tables `templates` (template spectra) and `extinction_laws` (laws of the dust inside galaxies)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Float, Float32
from lake_schema.columns import Column, Table
from lake_schema.tables.common import Origin

LIBRARIES = (
    ("galaxy", "rest frame"),
    ("qso", "rest frame"),
    ("high_redshift", "rest frame"),
    ("star", "as observed"),
)

TEMPLATES = Table(
    "templates",
    1,
    (
        Column(
            "library", "string", ucd="meta.code.class", doc="kind of sources that use the spectrum", codes=LIBRARIES
        ),
        Column("sed", "int16", ucd="meta.code", doc="index, the sed or sed_k of those sources", lo=0),
        Column("name", "string", ucd="meta.title", doc="label"),
        Column(
            "first_wavelength",
            "float64",
            "Angstrom",
            "em.wl;stat.min",
            "vacuum wavelength of the first sample",
            1.0,
            1e6,
        ),
        Column("wavelength_step", "float64", "Angstrom", "em.wl;spect.binSize", "distance between samples", 1e-3, 1e3),
        Column(
            "flux",
            "list<float32>",
            "",
            "phot.flux.density;arith.ratio",
            "f_lambda, mean 1 in 5450-5550 A; of high_redshift 1 at 1500 A, of qso the continuum 1 at 5000 A",
            0.0,
            1e7,
        ),
        Column("teff", "float32", "K", "phys.temperature.effective", "effective temperature", 300.0, 1e6, True),
        Column("log_g", "float32", "", "phys.gravity", "log10 of the surface gravity / (cm s-2)", -1.0, 10.0, True),
        Column("source", "string", ucd="meta.ref", doc="files from which it was made, and their reference"),
        Column("sha256", "string", ucd="meta.checksum", doc="sha256 of the concatenated files, hexadecimal"),
    ),
    "Template spectra of galaxies and stars.",
    key=("library", "sed"),
)


class Types(Protocol):
    """Stellar parameters of the first n spectra of a library of star spectra.

    Attributes
    ----------
    teff : float64 array, shape (n,)
        Effective temperatures in K.
    log_g : float64 array, shape (n,)
        log10 of the surface gravities in cm s-2.
    """

    @property
    def teff(self) -> Float: ...
    @property
    def log_g(self) -> Float: ...


class Library(Protocol):
    """Attributes of a library of n template spectra that `rows` needs.

    Attributes
    ----------
    wavelength : float array, shape (m,)
        Vacuum wavelengths in angstrom, in equal steps.
    flux : float32 array, shape (n, m)
        Flux densities f_lambda, normalised as the description of the column `flux` says.
    names : sequence of str, length n
        Labels of the spectra.
    types : Types or None
        Temperatures and gravities of the first spectra, None for a library without stellar parameters.
    """

    @property
    def wavelength(self) -> Float: ...
    @property
    def flux(self) -> Float32: ...
    @property
    def names(self) -> Sequence[str]: ...
    @property
    def types(self) -> Types | None: ...


def rows(libraries: Mapping[str, Library], origins: Mapping[str, Sequence[Origin]]) -> pa.Table:
    """Build the rows of the table `templates` from libraries of spectra, by name ("galaxy", "star" ...).

    `origins` contains the file and reference of each spectrum, by name of the library; KeyError is raised if a library
    is missing from it.
    """
    library_tables = (_rows(name, library, origins[name]) for name, library in libraries.items())
    return pa.concat_tables([TEMPLATES.empty(), *library_tables])


def _rows(name: str, library: Library, origins: Sequence[Origin]) -> pa.Table:
    n, wavelength = len(library.names), library.wavelength
    star_types: dict[str, Any] = {}
    if library.types is not None:
        star_types = {"teff": _pad_missing(library.types.teff, n), "log_g": _pad_missing(library.types.log_g, n)}
    return TEMPLATES.build(
        {
            "library": [name] * n,
            "sed": np.arange(n),
            "name": list(library.names),
            "first_wavelength": np.full(n, wavelength[0]),
            "wavelength_step": np.full(n, wavelength[1] - wavelength[0]),
            "flux": [np.asarray(spectrum) for spectrum in library.flux],
            "source": [origin.source for origin in origins],
            "sha256": [origin.sha256 for origin in origins],
            **star_types,
        }
    )


def _pad_missing(values: Float, n: int) -> Any:
    """Return a masked array of length `n` that begins with `values`; the elements after them are masked."""
    missing = np.arange(n) >= len(values)
    return np.ma.masked_array(np.concatenate([values[:n], np.zeros(max(n - len(values), 0))]), missing)


EXTINCTION_LAWS = Table(
    "extinction_laws",
    1,
    (
        Column("law", "int16", ucd="meta.code", doc="code, the ext_law_k of galaxies", lo=0),
        Column(
            "first_wavelength",
            "float64",
            "Angstrom",
            "em.wl;stat.min",
            "vacuum wavelength of the first sample",
            1.0,
            1e6,
        ),
        Column("wavelength_step", "float64", "Angstrom", "em.wl;spect.binSize", "distance between samples", 1e-3, 1e3),
        Column("k", "list<float32>", "", "phys.absorption", "A(lambda) / E(B-V), rest frame", 0.0, 1e3),
        Column("source", "string", ucd="meta.ref", doc="files from which it was made, and their reference"),
        Column("sha256", "string", ucd="meta.checksum", doc="sha256 of the concatenated files, hexadecimal"),
    ),
    "Extinction laws of the dust inside galaxies, on the wavelengths of the galaxy templates.",
    key=("law",),
)


def law_rows(wavelength: Float, k: Float32, origins: Sequence[Origin]) -> pa.Table:
    """Build the rows of the table `extinction_laws`.

    Parameters
    ----------
    wavelength : float array, shape (m,)
        Wavelengths in angstrom, with equal steps.
    k : float32 array, shape (n, m)
        A(lambda) / E(B-V) of each law, in mag / mag, in the order of the codes of the laws (column ext_law_k).
    origins : sequence of Origin, length n
        File and reference of each law.

    Returns
    -------
    pyarrow.Table
        Table with n rows.
    """
    n = len(k)
    return EXTINCTION_LAWS.build(
        {
            "law": np.arange(n),
            "first_wavelength": np.full(n, wavelength[0]),
            "wavelength_step": np.full(n, wavelength[1] - wavelength[0]),
            "k": [np.asarray(curve, np.float32) for curve in k],
            "source": [origin.source for origin in origins],
            "sha256": [origin.sha256 for origin in origins],
        }
    )
