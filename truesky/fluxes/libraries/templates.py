"""Load the built-in libraries of spectra: 31 galaxies, and the stars.

Galaxies are mixtures of the four spectra of Coleman, Wu & Weedman 1980 and of a young burst. Stars are dwarfs from O9
to T8 with the colours of Pecaut & Mamajek 2013, calibration sources, and models by temperature, gravity and
metallicity. Both libraries take seconds to compute, and are then memory-mapped from the cache.
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
from truesky.numerics import cache
from truesky.numerics.code_fingerprints import code_key

_ANCHORS = ("E", "Sbc", "Scd", "Im")
# Exponent of f_lambda beyond 22050 A, where the published spectra end.
_INFRARED_SLOPE = -3.2
# A straight line replaces weak lines in the observed spectra within this distance on both sides, A.
_LINE_MASK = 40.0

# The sequence: first and last template k, earlier and later anchor, offset, denominator and factor of
# x = factor (k - offset) / denominator, spectrum = (1 - x) earlier + x later. Adopted, to span the colours
# of the 31 templates of Ilbert et al. 2009 (NUV - r from 5.7 to -0.7).
YOUNG = "young"
_SEQUENCE = (
    (0, 7, "E", "Sbc", 0, 7, 0.72),
    (8, 13, "Sbc", "Scd", 8, 5, 1.0),
    (14, 19, "Scd", "Im", 13, 6, 1.0),
    (20, 30, "Im", YOUNG, 19, 11, 0.95),
)
GALAXY_LIBRARY_SIZE = 31
# The young end, adopted: Planck spectra (K, share of f_lambda at 5500 A, factor below the Balmer edge).
_YOUNG = ((28000.0, 0.70, 1.0), (9500.0, 0.22, 0.45), (4200.0, 0.08, 1.0))
_BALMER_EDGE, _LYMAN_EDGE, _BELOW_LYMAN = 3646.0, 912.0, 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Library:
    """Template spectra on a common wavelength grid. Libraries are immutable and compared by identity.

    Attributes
    ----------
    wavelength : float array, shape (n_lambda,)
        Wavelengths in A, whole numbers in steps of 1.
    flux : float32 array, shape (n, n_lambda)
        f_lambda with mean 1 between 5450 and 5550 A.
    names : tuple of str
        Label of each template.
    types : stellar.StellarTypes, optional
        Properties of the dwarf sequence, the first stars of the library; None for galaxies.
    dust : float32 array, shape (5, n_lambda), optional
        k(lambda) of the extinction laws in galaxies; None for those of extinction.laws.
    external : bool
        True if the library is from external files. Errors measured for the built-in library do not apply to it.
    intergalactic : bool
        True if intergalactic hydrogen absorbs (truesky.fluxes.spectra.intergalactic).
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
    """Return the 31 galaxy templates, from 0 (elliptical) to 30 (starburst), at 80 to 24500 A in the rest frame."""
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
    """Return the names of the two spectra of which a galaxy template is a mixture."""
    row = next(row for row in _SEQUENCE if row[0] <= template <= row[1])
    return row[2], row[3]


@lru_cache(maxsize=1)
def stellar_library() -> Library:
    """Return the stellar library on the observed-frame grid.

    Notes
    -----
    Templates 0 to 75 are the dwarfs O9V to M9V, hottest first, with their table of types. Templates 76 to 440 are the L
    and T dwarfs, 441 to 443 Vega, a white dwarf and a planetary nebula. The models of model_stars begin at 444.
    """
    types = stellar.types()
    names = (*types.names, *brown_dwarfs.template_names(), *standards.NAMES, *model_stars.names())
    files = vega.spectrum_file("vega.txt").read_bytes(), model_stars.TABLE.read_bytes()
    key = cache.content_key(code_key(__name__), *files, stellar.fingerprint())
    arrays = cache.cached_arrays("stellar_library", key, lambda: {"flux": _star_spectra(types)})
    return Library(passbands.grid(), arrays["flux"], names, types)


def first_model() -> int:
    """Return the index of the first model of model_stars in the stellar library."""
    return len(stellar.types().names) + brown_dwarfs.COUNT + len(standards.NAMES)


def _star_spectra(types: stellar.StellarTypes) -> Float32:
    dwarfs = stellar.spectra(types, *vega.vega())
    parts = [dwarfs, brown_dwarfs.spectra(), standards.spectra(*vega.vega()), model_stars.spectra(dwarfs, types)]
    return np.concatenate(parts).astype(np.float32)


def emission_wavelengths() -> Float:
    """Return vacuum wavelengths in A of the lines to remove from the observed spectra, float64[10] (lines.csv)."""
    with (files("truesky.fluxes.spectra") / "lines.csv").open(encoding="utf-8") as file:
        return np.array([float(row["vacuum"]) for row in csv.DictReader(file) if int(row["bridged"])])


def galaxy_spectra(wavelength: Float, bridge_width: float = _LINE_MASK) -> Float:
    """Return the spectra of the galaxy templates.

    Parameters
    ----------
    wavelength : float array, shape (n_lambda,)
        Wavelengths in A.
    bridge_width : float, optional
        Distance in A from each emission line within which a straight line replaces the spectrum; below 0 for none.

    Returns
    -------
    float array, shape (31, n_lambda)
        f_lambda.
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
    # Interpolate the logarithm, since an elliptical fades by half between the samples in the ultraviolet, 100 A apart.
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
