"""Spectra of dwarf stars from what is published about their colours.

types       the mean dwarf sequence O9V .. M9V of Pecaut & Mamajek 2013: temperatures, magnitudes, colours
spectra     a Planck spectrum a type, with absorption features, times a smooth curve that brings the colours
planck      f_lambda of a black body
normalised  mean f_lambda = 1 between 5450 and 5550 A
TABLE       file of the published table; table: its columns
matching, corrected, shape: the steps, for other kinds of stars

Metal-poor stars and giants take the spectrum of the dwarf of their temperature.
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

# Every spectrum of a library has mean f_lambda = 1 between these, A, so that mixtures are linear in flux.
NORMALISATION_RANGE = (5450.0, 5550.0)

_FIRST, _LAST = "O9V", "M9V"
# Passbands of the table's colours; all are tied to V.
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
# Colours are matched to this, mag; the late M dwarfs take the most passes (about 100).
_TOLERANCE = 2e-7, 400
# log10 of the Sun's surface gravity, cm s-2 (IAU 2015 nominal values).
_LOG_G_SUN = 4.438
# Hydrogen: Rydberg's wavelength in vacuum, A; lines of a series that are drawn.
_RYDBERG = 911.763
_SERIES_LINES = 12
# Strength of the hydrogen features: Gaussian in ln(Teff) about A0.
_HYDROGEN_PEAK, _HYDROGEN_WIDTH = 9500.0, 0.3

_FEATURES = Path(__file__).with_name("stellar_features.csv")
TABLE = Path(__file__).with_name("dwarf_sequence.csv")


@dataclass(frozen=True, slots=True)
class StellarTypes:
    """The mean dwarf sequence, hottest first; all arrays float64[n], magnitudes Vega.

    teff K, log_g of cm s-2, mass Msun, abs_mag_v (Johnson), abs_mag_j, abs_mag_h, abs_mag_ks (2MASS)
    bolometric_h : M_bol - M_H
    colors : m_band - m_V of each of the bands U B V R I J H Ks, float64[n, 8], NaN where unknown
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
        return self.colors[:, 1]

    @property
    def v_minus_h(self) -> Float:
        return -self.colors[:, 6]


def types() -> StellarTypes:
    """The table of Pecaut & Mamajek 2013 (version 2022.04.16), O9V to M9V."""
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
    """Spectral types from `first` to `last`, and the columns of the table of dwarfs by title, NaN where unknown."""
    with TABLE.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    names = [row["SpT"] for row in rows]
    selected = slice(names.index(first), names.index(last) + 1)
    columns = {
        title: np.array([float(row[title] or "nan") for row in rows[selected]]) for title in rows[0] if title != "SpT"
    }
    return tuple(names[selected]), columns


def fingerprint() -> str:
    """Key of everything the spectra depend on."""
    responses = [array for name in _BANDS for array in (passbands.load(name).wavelength, passbands.load(name).response)]
    return cache.content_key(code_key(__name__), TABLE.read_bytes(), *responses)


def spectra(stars: StellarTypes, vega_wavelength: Float, vega_flux: Float) -> Float:
    """f_lambda of each type on the grid of passbands.grid(), float64[n, 23401], normalised.

    Error: Vega colours within 1e-6 mag of the table's, where it has them
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
    """Planck's f_lambda, 1 at 5500 A; wavelength A, temperature K."""
    middle = float(np.mean(NORMALISATION_RANGE))
    scale = PLANCK_ERG_S * LIGHT_ANGSTROM_S / (BOLTZMANN_ERG_K * temperature)
    at, reference = scale / wavelength, scale / middle
    # exp(-x) / (1 - exp(-x)), not 1 / (exp(x) - 1), which overflows in the far ultraviolet of cool stars.
    return np.asarray((middle / wavelength) ** 5 * np.exp(reference - at) * np.expm1(-reference) / np.expm1(-at))


def normalise(wavelength: Float, flux: Float) -> Float:
    """flux [..., n_lambda] divided by its mean between 5450 and 5550 A."""
    inside = (wavelength >= NORMALISATION_RANGE[0]) & (wavelength <= NORMALISATION_RANGE[1])
    return np.asarray(flux / flux[..., inside].mean(-1, keepdims=True))


def _match_colors(log_wavelength: Float, start: Float, response: Float, pivots: Float, colors: Float) -> Float:
    """`start` times 10^(-0.4 c) with the wanted colours; c is cubic between the pivots, constant outside."""
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
    """The correction at the pivots, mag, that brings the colours m_band - m_(band `tied`); see `corrected`.

    response : float64[n_lambda, n_band] f_nu = f_lambda @ response;  first : where to begin
    until    : (largest error of a colour, mag; steps), whichever is reached first
    log_wavelength : float64[n_lambda];  start : f_lambda there, before the correction
    pivots, colors : float64[n_band] log wavelengths of the correction, and the colours that are wanted, mag
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
    """`start` times 10^(-0.4 c): c is the correction, cubic between the pivots, constant outside.

    log_wavelength, start : float64[n_lambda];  pivots, correction : float64[n_band] log wavelengths and mag there
    """
    from scipy.interpolate import PchipInterpolator

    inside = np.clip(log_wavelength, pivots[0], pivots[-1])
    return np.asarray(start * 10.0 ** (-0.4 * PchipInterpolator(pivots, correction)(inside)))


def feature_transmission(wavelength: Float, teff: float) -> Float:
    """Transmission of the features (stellar_features.csv) at a temperature: texture, colours come after."""
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
    """Shape with peak 1: line, band shaded to the red, edge, or hydrogen series (centre = lower level).

    kind       : line, band, edge or series
    wavelength : float64[n_lambda] A;  centre, width : A
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
