"""Emission lines: where they are seen, how wide they are, and their profiles on the grid.

line_list            the ten lines of Serrano et al. 2024, table "Emission lines", and ten more (lines.csv)
width_law            numbers of the velocity dispersion
velocity_dispersion  from the luminosity
observed_wavelength  in vacuum, or in air
Profiles, profiles   bins of the grid and the flux that falls into each

A secondary line has a fixed fraction of its primary's flux; the catalogue holds the primary's flux alone.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float, Int
from lake_schema.errors import BadInput
from lake_schema.units import LIGHT_KM_S

TABLE = Path(__file__).with_suffix(".csv")

# Serrano et al. 2024, appendix B: log10 sigma = (A + B z) (M_r - C) + D z. The upper bound is adopted: below
# M_r = -23 the relation gives more than any galaxy has.
_SLOPE, _SLOPE_EVOLUTION, _MAGNITUDE_ZERO, _EVOLUTION = -0.10, 0.01, 3.0, -0.05
SIGMA_MIN, SIGMA_MAX = 50.0, 400.0

# Ciddor 1996, eq. 1: n - 1 of standard air (15 C, 101325 Pa, 450 ppm CO2) in 1e-8, wave numbers in 1/um.
_CIDDOR = ((5_792_105.0, 238.0185), (167_917.0, 57.362))

# Profiles are cut here, in sigma; the 2e-8 of the flux outside is spread over the rest.
_REACH = 5.6


@dataclass(frozen=True, slots=True)
class Line:
    """name; column of the table `galaxies`; flux relative to that column; wavelengths in vacuum and air, A; source."""

    name: str
    column: str
    ratio: float
    vacuum: float
    air: float
    source: str


@dataclass(frozen=True, slots=True)
class Profiles:
    """Flux of m lines in bins of 1 A.

    row      : int64[m] the source each belongs to
    first    : int64[m] wavelength of the first bin's centre, A
    f_lambda : float64[m, w], mean over each bin
    """

    row: Int
    first: Int
    f_lambda: Float


@cache
def line_list() -> tuple[Line, ...]:
    """All lines, primaries before their secondaries."""
    with TABLE.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return tuple(
        Line(row["name"], row["column"], float(row["ratio"]), float(row["vacuum"]), float(row["air"]), row["source"])
        for row in rows
    )


def columns() -> tuple[str, ...]:
    """Columns of the table `galaxies` with line fluxes."""
    return tuple(dict.fromkeys(line.column for line in line_list()))


def width_law() -> dict[str, float]:
    """Numbers of `velocity_dispersion` by their name in table `emission_lines`."""
    names = ("width_slope", "width_slope_z", "width_magnitude", "width_z", "width_least", "width_most")
    numbers = (_SLOPE, _SLOPE_EVOLUTION, _MAGNITUDE_ZERO, _EVOLUTION, SIGMA_MIN, SIGMA_MAX)
    return dict(zip(names, numbers, strict=True))


def velocity_dispersion(abs_mag_r01: npt.ArrayLike, z_obs: npt.ArrayLike) -> Float:
    """Gaussian sigma of the lines, km/s, within [50, 400].

    abs_mag_r01 : M(0.1r) - 5 log10 h.  Ref: Serrano et al. 2024, appendix B, eq. sigma_el
    """
    mag, z = np.asarray(abs_mag_r01, float), np.asarray(z_obs, float)
    log_sigma = (_SLOPE + _SLOPE_EVOLUTION * z) * (mag - _MAGNITUDE_ZERO) + _EVOLUTION * z
    return np.asarray(np.clip(10.0 ** np.clip(log_sigma, -300.0, 300.0), SIGMA_MIN, SIGMA_MAX))


def air_wavelength(vacuum: npt.ArrayLike) -> Float:
    """Vacuum -> standard air, A, above 2000 A.  Ref: Ciddor 1996, eq. 1"""
    lam = np.asarray(vacuum, float)
    square = (1e4 / lam) ** 2
    refractivity = 1e-8 * sum(strength / (resonance - square) for strength, resonance in _CIDDOR)
    return np.asarray(lam / (1.0 + refractivity))


def observed_wavelength(vacuum: npt.ArrayLike, z_obs: npt.ArrayLike, medium: str) -> Float:
    """Where a line is seen, A.  Air refracts as at the observed wavelength, not as at the emitted one."""
    redshifted = np.asarray(vacuum, float) * (1.0 + np.asarray(z_obs, float))
    if medium == "vacuum":
        return redshifted
    if medium == "air":
        return air_wavelength(redshifted)
    raise BadInput(f"medium {medium!r} is not air or vacuum")


def refractivity_terms() -> Float:
    """(strength, resonance) of the two terms of `air_wavelength`, float64[2, 2]."""
    return np.array(_CIDDOR)


def profiles(
    fluxes: Float,
    z_obs: Float,
    sigma: Float,
    medium: str,
    first_wanted: float = 0.0,
    last_wanted: float = np.inf,
) -> Profiles:
    """Lines with flux that reach into [first_wanted, last_wanted] A, integrated over each bin of 1 A.

    fluxes : float64[n, n_line] erg s-1 cm-2, observed, of each line of `line_list`; NaN or 0 where there is none
    sigma  : float64[n] km/s
    In the observed frame a line is a Gaussian of centre lambda_i = mu_i (1 + z) and width sigma / c lambda_i,
    whose integral is the flux. Serrano et al. 2024 (appendix B, eq. f_el) print the un-redshifted centre and
    a stray 1 / (1 + z) in the exponent.
    z_obs  : float64[n];  medium : "air" or "vacuum", that the wavelengths are in
    Error: 2e-8 of the flux in the shape; the bins sum to the flux to 1e-14
    """
    from scipy.special import erf

    vacuum = np.array([line.vacuum for line in line_list()])
    row, line_index = np.nonzero(fluxes > 0.0)
    centre = observed_wavelength(vacuum[line_index], z_obs[row], medium)
    width = sigma[row] / LIGHT_KM_S * centre
    reach = _REACH * width + 1.0
    in_range = (centre + reach >= first_wanted) & (centre - reach <= last_wanted)
    row, line_index, centre, width = row[in_range], line_index[in_range], centre[in_range], width[in_range]
    half = int(np.ceil(_REACH * width.max(initial=0.0))) + 1
    first = np.rint(centre).astype(np.int64) - half
    edges = first[:, None] - 0.5 + np.arange(2 * half + 2)
    cumulative = 0.5 * erf((edges - centre[:, None]) / (np.sqrt(2.0) * width[:, None]))
    inside = cumulative[:, -1:] - cumulative[:, :1]
    return Profiles(row, first, np.diff(cumulative, axis=1) * (fluxes[row, line_index][:, None] / inside))


def add(spectra: Float, first: int, lines: Profiles) -> Float:
    """spectra float64[n, w], in place, with their lines; `first` is the wavelength of spectra[:, 0], A."""
    index = lines.first[:, None] - first + np.arange(lines.f_lambda.shape[1])
    inside = (index >= 0) & (index < spectra.shape[1])
    row = np.broadcast_to(lines.row[:, None], index.shape)
    # Two lines of a galaxy may share a bin, which a plain += would count once.
    np.add.at(spectra, (row[inside], index[inside]), lines.f_lambda[inside])
    return spectra
