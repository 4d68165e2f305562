"""Compute spectra of dwarf stars from published temperatures and colours.

The sequence O9V to M9V is from Pecaut & Mamajek 2013. The spectrum of a spectral type is a Planck spectrum with
absorption features, times a smooth curve that gives the published colours. The module `model_stars` computes spectra by
gravity and metallicity.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.units import BOLTZMANN_ERG_K, LIGHT_ANGSTROM_S, PLANCK_ERG_S
from truesky.fluxes import passbands
from truesky.numerics import cache, matrices
from truesky.numerics.code_fingerprints import code_key

# Spectra of galaxies and stars in a library have a mean f_lambda of 1 between these wavelengths (A). Fractions of
# templates in the mixture of a star are therefore fractions of the flux at 5500 A.
NORMALISATION_RANGE = (5450.0, 5550.0)

_FIRST, _LAST = "O9V", "M9V"
# Passbands of the colours in the published table. All colours are converted to m_band - m_V.
_BANDS = (
    "bessell_u",
    "bessell_b",
    "bessell_v",
    "bessell_r",
    "bessell_i",
    "twomass_j",
    "twomass_h",
    "twomass_ks",
)
_V = _BANDS.index("bessell_v")
# Largest error of a colour (mag), and largest number of iterations of the search for a spectrum with given colours.
# Late M dwarfs need the most iterations, about 100.
_TOLERANCE = 2e-7, 400
# log10 of the Sun's surface gravity, cm s-2 (IAU 2015 nominal values).
_LOG_G_SUN = 4.438
# Rydberg wavelength of hydrogen in vacuum, A.
_RYDBERG = 911.763
# Number of lines of a hydrogen series that are included.
_SERIES_LINES = 12
# The strength of hydrogen features is a Gaussian in ln(Teff): peak in K (type A0), and sigma.
_HYDROGEN_PEAK, _HYDROGEN_WIDTH = 9500.0, 0.3

_FEATURES = Path(__file__).with_name("stellar_features.csv")
TABLE = Path(__file__).with_name("dwarf_sequence.csv")


@dataclass(frozen=True, slots=True)
class StellarTypes:
    """The mean dwarf sequence, hottest first, with Vega magnitudes.

    Attributes
    ----------
    names : tuple of str
        Spectral types, such as "G2V".
    teff : float array, shape (n,)
        Effective temperature in K.
    log_g : float array, shape (n,)
        log10 of the surface gravity in cm s-2.
    mass : float array, shape (n,)
        Mass in solar masses.
    abs_mag_v : float array, shape (n,)
        Absolute magnitude in V (Johnson).
    abs_mag_j, abs_mag_h, abs_mag_ks : float array, shape (n,)
        Absolute magnitudes in J, H and Ks (2MASS).
    bolometric_h : float array, shape (n,)
        Bolometric correction of the H band, M_bol - M_H, in mag.
    colors : float array, shape (n, 8)
        Colours m_band - m_V (Vega) of the bands U B V R I J H Ks in mag, NaN if unknown.
    """

    names: tuple[str, ...]
    teff: Float
    log_g: Float
    mass: Float
    abs_mag_v: Float
    abs_mag_j: Float
    abs_mag_h: Float
    abs_mag_ks: Float
    bolometric_h: Float
    colors: Float

    @property
    def color_bv(self) -> Float:
        """Return the colour B - V of each type in mag (Vega), float64[n]."""
        return self.colors[:, 1]

    @property
    def v_minus_h(self) -> Float:
        """Return the colour V - H of each type in mag (Vega), float64[n]."""
        return -self.colors[:, 6]


def types() -> StellarTypes:
    """Return the properties of the dwarf types O9V to M9V: Pecaut & Mamajek 2013, table of version 2022.04.16."""
    names, column = table(_FIRST, _LAST)
    bv, vk, hk = column["B-V"], column["V-Ks"], column["H-Ks"]
    h = hk - vk
    colors = [column["U-B"] + bv, bv, 0.0 * vk, -column["V-Rc"], -column["V-Ic"], column["J-H"] + h, h, -vk]
    return StellarTypes(
        names,
        column["Teff"],
        _LOG_G_SUN + np.log10(column["Msun"]) - 2.0 * np.log10(column["R_Rsun"]),
        column["Msun"],
        column["Mv"],
        column["M_J"],
        column["M_Ks"] + hk,
        column["M_Ks"],
        column["BCv"] - h,
        np.stack(colors, 1),
    )


def table(first: str, last: str) -> tuple[tuple[str, ...], dict[str, Float]]:
    """Return the spectral types from `first` to `last`, and the columns of the table of dwarfs for these types.

    Columns are float arrays by their title in dwarf_sequence.csv, NaN where the table has no value. Raises ValueError
    if a type is unknown.
    """
    with TABLE.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    names = [row["SpT"] for row in rows]
    selected = slice(names.index(first), names.index(last) + 1)
    columns = {
        title: np.array([float(row[title] or "nan") for row in rows[selected]]) for title in rows[0] if title != "SpT"
    }
    return tuple(names[selected]), columns


def fingerprint() -> str:
    """Return a hash of the code, table and passbands on which the spectra depend, which identifies them in a cache."""
    responses = [array for name in _BANDS for array in (passbands.load(name).wavelength, passbands.load(name).response)]
    return cache.content_key(code_key(__name__), TABLE.read_bytes(), *responses)


def spectra(stars: StellarTypes, vega_wavelength: Float, vega_flux: Float) -> Float:
    """Return the normalised spectrum of each dwarf type at 600 to 24000 A (passbands.grid()).

    Parameters
    ----------
    stars : StellarTypes
        The n dwarf types.
    vega_wavelength : float array, shape (m,)
        Wavelengths of Vega's spectrum in A.
    vega_flux : float array, shape (m,)
        Vega's f_lambda in erg s-1 cm-2 A-1.

    Returns
    -------
    float array, shape (n, 23401)
        f_lambda with mean 1 between 5450 and 5550 A.

    Notes
    -----
    The Vega colours of the spectra differ from the published colours by at most 1e-6 mag. Bands for which the table has
    no colour are ignored.
    """
    grid = passbands.grid()
    bands = [passbands.load(name) for name in _BANDS]
    response = np.zeros((len(grid), len(bands)))
    for k, band in enumerate(bands):
        response[band.first : band.first + len(band.wavelength), k] = passbands.weights(band)
    vega = np.array([float(passbands.ab_flux(band, vega_wavelength, vega_flux)) for band in bands])
    pivots = np.log([passbands.pivot_wavelength(band) for band in bands])
    out = []
    for teff, colors in zip(stars.teff, stars.colors, strict=True):
        start = planck(grid, teff) * feature_transmission(grid, teff)
        out.append(_match_colors(np.log(grid), start, response / vega, pivots, colors))
    return normalise(grid, np.stack(out))


def planck(wavelength: Float, temperature: float) -> Float:
    """Return Planck's f_lambda, divided by its value at 5500 A, for wavelengths in A and a temperature in K."""
    middle = float(np.mean(NORMALISATION_RANGE))
    scale = PLANCK_ERG_S * LIGHT_ANGSTROM_S / (BOLTZMANN_ERG_K * temperature)
    at, reference = scale / wavelength, scale / middle
    # Use exp(-x) / (1 - exp(-x)), because 1 / (exp(x) - 1) overflows in the far ultraviolet of cool stars.
    return np.asarray((middle / wavelength) ** 5 * np.exp(reference - at) * np.expm1(-reference) / np.expm1(-at))


def normalise(wavelength: Float, flux: Float) -> Float:
    """Return spectra, shape (..., n_lambda), divided by their mean between 5450 and 5550 A; `wavelength` is in A."""
    inside = (wavelength >= NORMALISATION_RANGE[0]) & (wavelength <= NORMALISATION_RANGE[1])
    return np.asarray(flux / flux[..., inside].mean(-1, keepdims=True))


def _match_colors(log_wavelength: Float, start: Float, response: Float, pivots: Float, colors: Float) -> Float:
    """Return the spectrum `start` (f_lambda), multiplied by a smooth curve that gives it the colours m_band - m_V.

    `colors` are in mag; bands with NaN are ignored. `pivots` are ln of the bands' pivot wavelengths, and
    f_lambda @ response is the flux relative to Vega in each band.
    """
    has_color = np.isfinite(colors)
    at, v = pivots[has_color], int(np.sum(has_color[:_V]))
    correction = color_correction(log_wavelength, start, response[:, has_color], at, colors[has_color], v, _TOLERANCE)
    return apply_correction(log_wavelength, start, at, correction)


def color_correction(
    log_wavelength: Float,
    start: Float,
    response: Float,
    pivots: Float,
    colors: Float,
    reference: int,
    tolerance: tuple[float, int],
    first: Float | None = None,
) -> Float:
    """Find the correction, in mag at the pivot wavelengths, that gives a spectrum the colours m_band - m_reference.

    Parameters
    ----------
    log_wavelength : float array, shape (n_lambda,)
        ln(wavelength / A).
    start : float array, shape (n_lambda,)
        f_lambda before the correction.
    response : float array, shape (n_lambda, n_band)
        Weights of the bands: a colour is -2.5 log10 of the ratio of two elements of f_lambda @ response.
    pivots : float array, shape (n_band,)
        ln of the bands' pivot wavelengths (A), increasing, at which the correction is defined.
    colors : float array, shape (n_band,)
        Required colours in mag.
    reference : int
        Index of the reference band.
    tolerance : (float, int)
        Largest error of a colour in mag, and largest number of iterations. The search ends when either is reached,
        without an error.
    first : float array, shape (n_band,), optional
        Correction at which the search begins; 0 by default.

    Returns
    -------
    float array, shape (n_band,)
        Correction in mag for `apply_correction`.
    """
    correction = np.zeros(len(pivots)) if first is None else first
    for _ in range(tolerance[1]):
        fluxes = matrices.matmul(apply_correction(log_wavelength, start, pivots, correction), response)
        mags = -2.5 * np.log10(fluxes)
        color_error = colors - (mags - mags[reference])
        if np.abs(color_error).max() < tolerance[0]:
            break
        correction = correction + color_error
    return correction


def apply_correction(log_wavelength: Float, start: Float, pivots: Float, correction: Float) -> Float:
    """Return a spectrum times 10^(-0.4 c). The correction c is cubic between the pivots, and constant outside.

    Parameters
    ----------
    log_wavelength : float array, shape (n_lambda,)
        ln(wavelength / A).
    start : float array, shape (n_lambda,)
        f_lambda before the correction.
    pivots : float array, shape (n_band,)
        ln of the bands' pivot wavelengths (A), increasing.
    correction : float array, shape (n_band,)
        Correction c at the pivots in mag.

    Returns
    -------
    float array, shape (n_lambda,)
        f_lambda after the correction.
    """
    from scipy.interpolate import PchipInterpolator

    inside = np.clip(log_wavelength, pivots[0], pivots[-1])
    return np.asarray(start * 10.0 ** (-0.4 * PchipInterpolator(pivots, correction)(inside)))


def feature_transmission(wavelength: Float, teff: float) -> Float:
    """Return the transmission of a star's absorption features (stellar_features.csv), in the shape of `wavelength`.

    `wavelength` is in A and `teff` in K. The features only make spectra look realistic; callers correct the colours
    afterwards.
    """
    transmission = np.ones_like(wavelength)
    hydrogen = np.exp(-0.5 * (np.log(teff / _HYDROGEN_PEAK) / _HYDROGEN_WIDTH) ** 2)
    with _FEATURES.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            centre, width, depth = (float(row[name]) for name in ("centre", "width", "depth"))
            if row["teff_from"]:
                hot, cool = float(row["teff_from"]), float(row["teff_to"])
                strength = float(np.clip((hot - teff) / (hot - cool), 0.0, 1.0))
            else:
                strength = float(hydrogen)
            transmission *= 1.0 - strength * depth * feature_profile(row["kind"], wavelength, centre, width)
    return transmission


def feature_profile(kind: str, wavelength: Float, centre: float, width: float) -> Float:
    """Return the profile of an absorption feature with peak 1.

    Parameters
    ----------
    kind : str
        "line" (Gaussian), "band" (sharp blue end, exponential to the red), "edge" (absorption blueward of a wavelength)
        or "series" (hydrogen lines with a common lower level).
    wavelength : float array, shape (n_lambda,)
        Wavelengths in A.
    centre : float
        Wavelength of the feature in A; for a series, the number of the lower level (2 for Balmer).
    width : float
        Width in A: sigma of a line, length of the exponential of a band, or scale of an edge.

    Returns
    -------
    float array, shape (n_lambda,)
        Profile from 0 to 1.

    Raises
    ------
    BadInput
        If the kind is unknown.
    """
    if kind == "line":
        return np.asarray(np.exp(-0.5 * ((wavelength - centre) / width) ** 2))
    if kind == "band":
        return np.asarray(np.where(wavelength >= centre, np.exp(-np.abs(wavelength - centre) / width), 0.0))
    if kind == "edge":
        return np.asarray(0.5 * (1.0 - np.tanh(0.5 * (wavelength - centre) / width)))
    if kind == "series":
        upper = centre + 1.0 + np.arange(_SERIES_LINES)
        lines = _RYDBERG / (centre**-2 - upper**-2)
        return np.asarray(np.exp(-0.5 * ((wavelength[:, None] - lines) / width) ** 2).max(1))
    raise BadInput(f"{_FEATURES.name}: kind {kind!r} is not line, band, edge or series")
