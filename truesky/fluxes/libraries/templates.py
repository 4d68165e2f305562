"""Load the built-in libraries of spectra: 31 galaxies, and the stars.

Galaxies are mixtures of the four spectra of Coleman, Wu & Weedman 1980 and of a young burst. Stars are dwarfs from O9
to T8 with the colours of Pecaut & Mamajek 2013, calibration sources, and models by temperature, gravity and
metallicity. Both libraries take seconds to compute. They are kept in a cache on disc, from which they are
memory-mapped.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

import numpy as np

from lake_schema.arrays import Float, Float32
from truesky.fluxes import passbands
from truesky.fluxes.libraries import brown_dwarfs, model_stars, rest_grid, standards, stellar, vega
from truesky.fluxes.libraries.stellar import normalise, planck
from truesky.numerics import cache, cache_labels
from truesky.numerics.code_fingerprints import code_key

_ANCHORS = ("E", "Sbc", "Scd", "Im")
# Exponent of f_lambda (a power of lambda) beyond 22050 A, where the published spectra end.
_INFRARED_SLOPE = -3.2
# Half-width (A) of the range around each emission line in the published spectra that is replaced by a straight line.
_LINE_MASK = 40.0

# Name of the spectrum of a young burst of star formation, which is computed in this module.
YOUNG = "young"
# The sequence of galaxy templates k: first and last k, earlier and later spectrum, offset, denominator and factor. The
# template is (1 - x) earlier + x later, with x = factor (k - offset) / denominator. These numbers are adopted, to span
# the colours of the 31 templates of Ilbert et al. 2009 (NUV - r from 5.7 to -0.7).
_SEQUENCE = (
    (0, 7, "E", "Sbc", 0, 7, 0.72),
    (8, 13, "Sbc", "Scd", 8, 5, 1.0),
    (14, 19, "Scd", "Im", 13, 6, 1.0),
    (20, 30, "Im", YOUNG, 19, 11, 0.95),
)
GALAXY_LIBRARY_SIZE = 31
# The young burst is a sum of Planck spectra: temperature (K), share of f_lambda at 5500 A, and factor below the Balmer
# edge. These numbers are adopted.
_YOUNG = ((28000.0, 0.70, 1.0), (9500.0, 0.22, 0.45), (4200.0, 0.08, 1.0))
# Wavelengths of the Balmer and Lyman edges (A), and factor of the burst's spectrum below the Lyman edge.
_BALMER_EDGE, _LYMAN_EDGE, _BELOW_LYMAN = 3646.0, 912.0, 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Library:
    """Template spectra at common wavelengths. Libraries are immutable, and are equal only if they are the same object.

    Attributes
    ----------
    wavelength : float array, shape (n_lambda,)
        Wavelengths in A, whole numbers in steps of 1; in the rest frame for galaxies.
    flux : float32 array, shape (n, n_lambda)
        f_lambda; galaxies and stars have mean 1 between 5450 and 5550 A.
    names : tuple of str
        Label of each template.
    types : stellar.StellarTypes, optional
        Properties of the dwarf sequence, the first stars of the library; None for galaxies.
    dust : float32 array, shape (5, n_lambda), optional
        k(lambda) of five extinction laws of dust in galaxies; None for the built-in ones (extinction.laws).
    external : bool
        True if spectra or laws are from a user's files. Errors measured for the built-in library do not apply to it.
    intergalactic : bool
        True if intergalactic hydrogen absorbs light of galaxies (truesky.fluxes.spectra.intergalactic).
    """

    wavelength: Float
    flux: Float32
    names: tuple[str, ...]
    types: stellar.StellarTypes | None = None
    dust: Float32 | None = None
    external: bool = False
    intergalactic: bool = False

    def __len__(self) -> int:
        return len(self.names)


@lru_cache(maxsize=1)
def galaxy_library() -> Library:
    """Return the built-in library of 31 galaxies, from 0 (elliptical) to 30 (starburst).

    Rest-frame wavelengths are 80 to 24500 A in steps of 1 A.
    """
    key = cache.content_key(
        code_key(__name__),
        emission_wavelengths(),
        *(vega.spectrum_file(f"CWW_{name}_ext.sed").read_bytes() for name in _ANCHORS),
    )
    wavelength = rest_grid.rest_grid()
    arrays = cache.cached_arrays("galaxy_library", key, lambda: {"flux": galaxy_spectra(wavelength).astype(np.float32)})
    names = tuple(
        name for first, last, early, late, *_ in _SEQUENCE for name in [f"{early}-{late}"] * (last - first + 1)
    )
    return Library(wavelength, arrays["flux"], tuple(f"{k:02d} {name}" for k, name in enumerate(names)))


def template_anchors(template: int) -> tuple[str, str]:
    """Return the names of the two spectra of which a built-in galaxy template (0 to 30) is a mixture.

    They are "E", "Sbc", "Scd", "Im" (Coleman, Wu & Weedman 1980) or `YOUNG`.
    """
    row = next(row for row in _SEQUENCE if row[0] <= template <= row[1])
    return row[2], row[3]


@lru_cache(maxsize=1)
def stellar_library() -> Library:
    """Return the built-in library of stars at 600 to 24000 A in steps of 1 A.

    Notes
    -----
    Templates 0 to 75 are the dwarfs O9V to M9V, hottest first, whose properties are in `types`. Templates 76 to 440 are
    the L and T dwarfs, 441 to 443 Vega, a white dwarf and a planetary nebula. Models by temperature, gravity and
    metallicity begin at 444.
    """
    types = stellar.types()
    names = (*types.names, *brown_dwarfs.template_names(), *standards.NAMES, *model_stars.names())
    files = vega.spectrum_file("vega.txt").read_bytes(), model_stars.TABLE.read_bytes()
    key = cache.content_key(code_key(__name__), *files, stellar.fingerprint())
    arrays = cache.cached_arrays(
        "stellar_library", key, lambda: {"flux": _star_spectra(types)}, cache_labels.label_spectra()
    )
    return Library(passbands.grid(), arrays["flux"], names, types)


def first_model() -> int:
    """Return the index in the stellar library of the first model by temperature, gravity and metallicity."""
    return len(stellar.types().names) + brown_dwarfs.COUNT + len(standards.NAMES)


def _star_spectra(types: stellar.StellarTypes) -> Float32:
    dwarfs = stellar.spectra(types, *vega.vega())
    parts = [dwarfs, brown_dwarfs.spectra(), standards.spectra(*vega.vega()), model_stars.spectra(dwarfs, types)]
    return np.concatenate(parts).astype(np.float32)


def emission_wavelengths() -> Float:
    """Return the vacuum wavelengths (A) of the emission lines to remove from the published galaxy spectra, float64[10].

    They are the lines of lines.csv with `bridged` = 1.
    """
    with (files("truesky.fluxes.spectra") / "lines.csv").open(encoding="utf-8") as file:
        return np.array([float(row["vacuum"]) for row in csv.DictReader(file) if int(row["bridged"])])


def galaxy_spectra(wavelength: Float, bridge_width: float = _LINE_MASK) -> Float:
    """Compute the spectra of the 31 galaxy templates.

    Parameters
    ----------
    wavelength : float array, shape (n_lambda,)
        Rest-frame wavelengths in A, increasing. They must contain 5450 to 5550 A.
    bridge_width : float, optional
        Distance in A from each emission line within which a straight line replaces the spectrum. With a negative number
        lines stay.

    Returns
    -------
    float array, shape (31, n_lambda)
        f_lambda with mean 1 between 5450 and 5550 A.
    """
    anchors = {name: _anchor_spectrum(name, wavelength, bridge_width) for name in _ANCHORS}
    anchors[YOUNG] = _young_spectrum(wavelength)
    spectra = []
    for first, last, early, late, offset, denominator, factor in _SEQUENCE:
        for k in range(first, last + 1):
            x = factor * (k - offset) / denominator
            spectra.append((1.0 - x) * anchors[early] + x * anchors[late])
    return normalise(wavelength, np.stack(spectra))


def _anchor_spectrum(name: str, wavelength: Float, bridge_width: float) -> Float:
    table = np.loadtxt(vega.spectrum_file(f"CWW_{name}_ext.sed").read_text().splitlines())
    at, flux = table[:, 0], table[:, 1]
    # Interpolate the logarithm: in the ultraviolet, an elliptical fades by half between two samples, 100 A apart.
    sampled = np.exp(np.interp(wavelength, at, np.log(flux), left=-np.inf))
    sampled = np.where(wavelength > at[-1], flux[-1] * (wavelength / at[-1]) ** _INFRARED_SLOPE, sampled)
    line_free = (np.abs(wavelength[:, None] - emission_wavelengths()) > bridge_width).all(1)
    return normalise(wavelength, np.interp(wavelength, wavelength[line_free], sampled[line_free]))


def _young_spectrum(wavelength: Float) -> Float:
    parts = [
        share * planck(wavelength, temperature) * np.where(wavelength < _BALMER_EDGE, factor, 1.0)
        for temperature, share, factor in _YOUNG
    ]
    return normalise(wavelength, np.sum(parts, 0) * np.where(wavelength < _LYMAN_EDGE, _BELOW_LYMAN, 1.0))
