"""Read stellar spectra from a user's files, which replace the built-in stars from O9 to M9.

Dwarfs come from BaSeL models (Lejeune, Cuisinier & Buser 1997, .cor files), and also replace stars of other gravities
and metallicities. Infrared spectra come from stars observed with the IRTF, which have a similar Y - H colour. Either
kind of file may be missing. Errors are BadInput; messages name the file.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from lake_schema import user_files
from lake_schema.arrays import Float, Int
from lake_schema.errors import BadInput
from lake_schema.units import LIGHT_ANGSTROM_S
from truesky.fluxes import passbands
from truesky.fluxes.libraries import from_files, model_stars, stellar, templates
from truesky.fluxes.libraries.from_files import ANGSTROM, Curve, check_curve, resample
from truesky.fluxes.libraries.stellar import StellarTypes, normalise
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.passbands import Passband

# Format of a BaSeL file: Lejeune, Cuisinier & Buser 1997, ReadMe. It begins with 1221 wavelengths in nm, 8 per line.
# Each model has a header line "2I6,4F6.2" and 1221 values of the Eddington flux H_nu, 7 per line. It is converted to
# f_lambda = 4 pi H_nu c / lambda^2 / pi.

# Number of wavelengths in a BaSeL file.
_BASEL_COUNT = 1221
# Number of characters of a wavelength, and of a value of H_nu, in a BaSeL file.
_BASEL_WAVELENGTH_WIDTH, _BASEL_FLUX_WIDTH = 10, 11
# Index of the first character of each of the first five columns in a header line of a BaSeL file.
_BASEL_HEADER = (0, 6, 12, 18, 24)

# Wavelength in the middle of the range in which spectra are normalised, 5500 A.
_VISUAL = float(np.mean(stellar.NORMALISATION_RANGE))

# Bands of the colour by which dwarfs and IRTF stars are compared.
SPLICE_BANDS = ("euclid_y", "euclid_h")
# First and last wavelength of an IRTF spectrum that is used, A.
_SPLICE_FROM, _SPLICE_TO = 8_200.0, 24_000.0
# Width (A) of the ranges at both ends of an IRTF spectrum in which its mean is scaled to that of the replaced spectrum.
_SPLICE_JOIN = 200.0


@dataclass(frozen=True, slots=True)
class BaselModels:
    """Model spectra of a BaSeL file.

    Attributes
    ----------
    wavelength : float array, shape (1221,)
        Wavelengths in A.
    teff : float array, shape (n,)
        Effective temperature in K.
    log_g, metallicity : float array, shape (n,)
        log10 of the surface gravity in cm s-2, and [M/H] in dex.
    flux : float array, shape (n, 1221)
        f_lambda in an arbitrary unit, since spectra are normalised later.
    """

    wavelength: Float
    teff: Float
    log_g: Float
    metallicity: Float
    flux: Float


def library(models: Path | None, infrared: Sequence[Path]) -> tuple[Library, Int]:
    """Return the stellar library with dwarfs from a BaSeL file, infrared spectra from IRTF files, or both.

    Parameters
    ----------
    models : Path or None
        BaSeL file; None for the built-in dwarfs.
    infrared : sequence of Path
        IRTF files; empty to leave the infrared unchanged.

    Returns
    -------
    library : Library
        The stellar library, in which L and T dwarfs and calibration sources are the built-in ones.
    infrared_index : int array, shape (n,)
        For each dwarf the index of the IRTF file with its infrared spectrum, -1 if there are no IRTF files.

    Raises
    ------
    BadInput
        If a file cannot be read or is not valid.
    """
    embedded, types = templates.stellar_library(), stellar.types()
    grid, n = embedded.wavelength, len(types.names)
    flux = embedded.flux[:n].astype(float) if models is None else dwarf_spectra(models, types, grid)
    infrared_index = np.full(n, -1)
    first = templates.first_model()
    model_flux = embedded.flux[first:].astype(float)
    if infrared:
        curves = [from_files.read(path, "irtf") for path in infrared]
        flux, infrared_index = splice(grid, flux, curves)
        model_flux, _ = splice(grid, model_flux, curves)
    flux = normalise(grid, flux)
    if models is not None:
        # A BaSeL file has a single metallicity. Its dwarfs therefore replace the models of all gravities and
        # metallicities.
        model_flux = model_stars.dwarf_spectra(flux, types)
    all_flux = np.concatenate([flux, embedded.flux[n:first], normalise(grid, model_flux)]).astype(np.float32)
    return replace(embedded, flux=all_flux, external=True), infrared_index


def dwarf_spectra(path: Path, types: StellarTypes, grid: Float) -> Float:
    """Return the normalised spectrum of each dwarf type from the models of a BaSeL file.

    Parameters
    ----------
    path : Path
        BaSeL file.
    types : StellarTypes
        The n dwarf types.
    grid : float array, shape (n_lambda,)
        Wavelengths in A, in steps of 1.

    Returns
    -------
    float array, shape (n, n_lambda)
        f_lambda with mean 1 between 5450 and 5550 A.

    Raises
    ------
    BadInput
        If the file is not valid, its models do not cover the temperatures of the types, or one has no flux at 5500 A.

    Notes
    -----
    Only models with the metallicity nearest to the Sun are used. At each temperature of the models, the model with the
    gravity nearest to that of the type is selected. Between two temperatures, ln(f_lambda) is linear in 1 / T, as for
    black bodies.
    """
    models = read_basel(path)
    solar = np.abs(models.metallicity)
    usable = np.flatnonzero(solar == solar.min())
    temperatures = np.unique(models.teff[usable])
    if types.teff.min() < temperatures[0] or types.teff.max() > temperatures[-1]:
        ends = f"{types.teff.min():g} .. {types.teff.max():g} K"
        raise BadInput(
            f"{path}: models of {temperatures[0]:g} .. {temperatures[-1]:g} K do not cover the dwarfs' {ends}"
        )

    def model(teff: float, log_g: float) -> int:
        same = usable[models.teff[usable] == teff]
        return int(same[np.argmin(np.abs(models.log_g[same] - log_g))])

    @cache
    def ln_flux(k: int) -> Float:
        spectrum = resample(grid, Curve(models.wavelength, models.flux[k]))
        if not np.interp(_VISUAL, grid, spectrum) > 0.0:
            raise BadInput(
                f"{path}: the model of {models.teff[k]:g} K, log g = {models.log_g[k]:g} has no flux at 5500 A"
            )
        return np.asarray(np.log(np.maximum(normalise(grid, spectrum), np.finfo(np.float32).tiny)))

    out = np.empty((len(types.teff), len(grid)))
    for spectrum, teff, log_g in zip(out, types.teff, types.log_g, strict=True):
        hot = int(np.clip(np.searchsorted(temperatures, teff), 1, len(temperatures) - 1))
        cool, warm = temperatures[hot - 1], temperatures[hot]
        share = (1.0 / cool - 1.0 / teff) / (1.0 / cool - 1.0 / warm)
        spectrum[:] = np.exp((1.0 - share) * ln_flux(model(cool, log_g)) + share * ln_flux(model(warm, log_g)))
    return normalise(grid, out)


def read_basel(path: Path) -> BaselModels:
    """Read all models of a BaSeL file (named lcb[mp]NN.cor); raises BadInput if the file is absent or not valid."""
    try:
        lines = user_files.read_text(path, "library of spectra").splitlines()
        wavelength, at = _read_numbers(lines, 0, _BASEL_COUNT, _BASEL_WAVELENGTH_WIDTH)
        labels, spectra = [], []
        while at < len(lines) and lines[at].strip():
            head = lines[at]
            labels.append([float(head[a:b]) for a, b in zip(_BASEL_HEADER[1:], (*_BASEL_HEADER[2:], 30), strict=True)])
            h_nu, at = _read_numbers(lines, at + 1, _BASEL_COUNT, _BASEL_FLUX_WIDTH)
            spectra.append(h_nu)
    except (ValueError, IndexError) as error:
        raise BadInput(f"{path}: cannot be read as BaSeL: {error}") from None
    if not spectra:
        raise BadInput(f"{path}: the file contains no model")
    angstrom = wavelength * ANGSTROM["nm"]
    for h_nu in spectra:
        check_curve(path, angstrom, h_nu, {"bounds": [1.0, 1e8], "covers": [2000.0, 20000.0], "largest_gap": 0.1})
    teff, log_g, metallicity = np.array(labels)[:, :3].T
    flux = 4.0 * np.stack(spectra) * LIGHT_ANGSTROM_S / angstrom**2
    return BaselModels(angstrom, teff, log_g, metallicity, flux)


def splice(wavelength: Float, flux: Float, stars: Sequence[Curve]) -> tuple[Float, Int]:
    """Replace the infrared part of spectra by the IRTF spectrum of the star with the nearest Y - H colour.

    Parameters
    ----------
    wavelength : float array, shape (n_lambda,)
        Wavelengths in A.
    flux : float array, shape (n, n_lambda)
        f_lambda of low-resolution spectra. It is not modified.
    stars : sequence of Curve
        IRTF spectra, at least one.

    Returns
    -------
    flux : float array, shape (n, n_lambda)
        The spectra with their infrared parts replaced.
    nearest : int array, shape (n,)
        Index of the IRTF star that is used for each spectrum.

    Notes
    -----
    The IRTF spectrum is multiplied by a linear function of wavelength that matches the low-resolution spectrum at both
    ends. The broad shape remains that of the low-resolution spectrum.
    """
    infrared = [np.interp(wavelength, star.wavelength, star.value) for star in stars]
    ends = [(max(star.wavelength[0], _SPLICE_FROM), min(star.wavelength[-1], _SPLICE_TO)) for star in stars]
    bands = [passbands.load(name) for name in SPLICE_BANDS]
    colors = np.array([_color(bands, wavelength, each) for each in infrared])
    out = np.array(flux, float)
    nearest = np.array([np.argmin(np.abs(colors - _color(bands, wavelength, spectrum))) for spectrum in out])
    for spectrum, k in zip(out, nearest, strict=True):
        blue, red = ends[k]
        inside = (wavelength >= blue) & (wavelength <= red)
        joins = [inside & (np.abs(wavelength - end) <= _SPLICE_JOIN) for end in (blue, red)]
        scale = [float(spectrum[join].mean() / infrared[k][join].mean()) for join in joins]
        share = (wavelength[inside] - blue) / (red - blue)
        spectrum[inside] = infrared[k][inside] * (scale[0] * (1.0 - share) + scale[1] * share)
    return out, nearest


def _color(bands: Sequence[Passband], wavelength: Float, flux: Float) -> float:
    y, h = (float(passbands.ab_flux(band, wavelength, flux)) for band in bands)
    return -2.5 * math.log10(y / h)


def _read_numbers(lines: Sequence[str], at: int, count: int, width: int) -> tuple[Float, int]:
    """Read `count` numbers, each of `width` characters, from successive lines that begin with index `at`.

    Return the numbers and the index of the next line. Raises ValueError if a line contains more numbers than are left
    or other text, and IndexError if lines are missing.
    """
    numbers: list[float] = []
    while len(numbers) < count:
        line = lines[at].rstrip()
        numbers += [float(line[k : k + width]) for k in range(0, len(line), width)]
        at += 1
    if len(numbers) != count:
        raise ValueError(f"line {at} contains too many numbers")
    return np.array(numbers), at
