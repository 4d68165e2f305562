"""Compute emission lines: their observed wavelengths, widths, and profiles on the grid.

lines.csv has the ten lines of Serrano et al. 2024, table "Emission lines", and ten more. The catalogue contains only
the fluxes of primary lines. The flux of a secondary line is a fixed multiple of that of its primary line.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float, Float32, Int
from lake_schema.errors import BadInput
from lake_schema.units import LIGHT_KM_S
from truesky.numerics.compiling import exact_jit

TABLE = Path(__file__).with_suffix(".csv")

# Coefficients A, B, C and D of the velocity dispersion in km/s, log10 sigma = (A + B z) (M_r - C) + D z: Serrano et al.
# 2024, appendix B.
_SLOPE, _SLOPE_EVOLUTION, _MAGNITUDE_ZERO, _EVOLUTION = -0.10, 0.01, 3.0, -0.05
# Smallest and largest velocity dispersion, km/s. The largest is adopted, because the relation gives unrealistically
# large values for galaxies brighter than M_r = -23.
SIGMA_MIN, SIGMA_MAX = 50.0, 400.0

# (strength, resonance) of the two terms of the refractivity n - 1 of standard air (15 C, 101325 Pa, 450 ppm CO2), in
# units of 1e-8 and for wave numbers in 1/um: Ciddor 1996, eq. 1.
_CIDDOR = ((5_792_105.0, 238.0185), (167_917.0, 57.362))

# Line profiles are cut at this distance from the centre, in sigma. The flux outside, a fraction of 2e-8, is distributed
# over the inside.
_REACH = 5.6

_Spectra = TypeVar("_Spectra", Float, Float32)


@dataclass(frozen=True, slots=True)
class Line:
    """One emission line.

    Attributes
    ----------
    name : str
        Name of the line.
    column : str
        Column of the table `galaxies` with the flux of this line, or of the primary line to which it is proportional.
    ratio : float
        Flux of this line relative to the column, 1 for a primary line.
    vacuum, air : float
        Rest-frame wavelengths in vacuum and in air in A.
    source : str
        Reference of the wavelengths and the ratio.
    """

    name: str
    column: str
    ratio: float
    vacuum: float
    air: float
    source: str


@dataclass(frozen=True, slots=True)
class Profiles:
    """Profiles of m emission lines in bins of 1 A. A source may have several lines.

    Attributes
    ----------
    row : int array, shape (m,)
        Index of the source to which the line belongs.
    first : int array, shape (m,)
        Wavelength of the centre of the line's first bin in A.
    f_lambda : float array, shape (m, w)
        Mean f_lambda in each bin in erg s-1 cm-2 A-1.
    """

    row: Int
    first: Int
    f_lambda: Float


@cache
def line_list() -> tuple[Line, ...]:
    """Return all emission lines in the order of lines.csv, each primary line before its secondary lines."""
    with TABLE.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return tuple(
        Line(row["name"], row["column"], float(row["ratio"]), float(row["vacuum"]), float(row["air"]), row["source"])
        for row in rows
    )


def columns() -> tuple[str, ...]:
    """Return the names of the columns of the table `galaxies` that contain fluxes of (primary) lines."""
    return tuple(dict.fromkeys(line.column for line in line_list()))


def width_law() -> dict[str, float]:
    """Return the coefficients and bounds (km/s) of the law in `velocity_dispersion`.

    They have the names of columns of the table `emission_lines`.
    """
    names = ("width_slope", "width_slope_z", "width_magnitude", "width_z", "width_least", "width_most")
    numbers = (_SLOPE, _SLOPE_EVOLUTION, _MAGNITUDE_ZERO, _EVOLUTION, SIGMA_MIN, SIGMA_MAX)
    return dict(zip(names, numbers, strict=True))


def velocity_dispersion(abs_mag_r01: npt.ArrayLike, z_obs: npt.ArrayLike) -> Float:
    """Return the velocity dispersion (Gaussian sigma) of a galaxy's emission lines.

    Parameters
    ----------
    abs_mag_r01 : array_like
        Absolute AB magnitude M(0.1r) - 5 log10 h.
    z_obs : array_like
        Redshift.

    Returns
    -------
    float array, broadcast shape of the arguments
        Velocity dispersion in km/s, limited to 50 to 400.

    References
    ----------
    Serrano et al. 2024, appendix B, eq. sigma_el.
    """
    mag, z = np.asarray(abs_mag_r01, float), np.asarray(z_obs, float)
    log_sigma = (_SLOPE + _SLOPE_EVOLUTION * z) * (mag - _MAGNITUDE_ZERO) + _EVOLUTION * z
    return np.asarray(np.clip(10.0 ** np.clip(log_sigma, -300.0, 300.0), SIGMA_MIN, SIGMA_MAX))


def air_wavelength(vacuum: npt.ArrayLike) -> Float:
    """Return the wavelength in standard air for a vacuum wavelength, both in A.

    The formula is valid above 2000 A, which is not checked.

    References
    ----------
    Ciddor 1996, eq. 1.
    """
    lam = np.asarray(vacuum, float)
    square = (1e4 / lam) ** 2
    refractivity = 1e-8 * sum(strength / (resonance - square) for strength, resonance in _CIDDOR)
    return np.asarray(lam / (1.0 + refractivity))


def observed_wavelength(vacuum: npt.ArrayLike, z_obs: npt.ArrayLike, medium: str) -> Float:
    """Return the observed wavelength of a redshifted line.

    Parameters
    ----------
    vacuum : array_like
        Rest-frame wavelength in vacuum in A.
    z_obs : array_like
        Redshift.
    medium : str
        Medium of the observed wavelength, "air" or "vacuum".

    Returns
    -------
    float array, broadcast shape of the arguments
        Observed wavelength in A. The refraction of air is that at the observed wavelength, not at the emitted one.

    Raises
    ------
    BadInput
        If the medium is unknown.
    """
    redshifted = np.asarray(vacuum, float) * (1.0 + np.asarray(z_obs, float))
    if medium == "vacuum":
        return redshifted
    if medium == "air":
        return air_wavelength(redshifted)
    raise BadInput(f"medium {medium!r} is not air or vacuum")


def refractivity_terms() -> Float:
    """Return the coefficients of the refractivity of air in `air_wavelength`, float64[2, 2].

    Each row is (strength, resonance) of a term strength / (resonance - wave number^2), in 1e-8 and 1/um^2.
    """
    return np.array(_CIDDOR)


def profiles(
    fluxes: Float,
    z_obs: Float,
    sigma: Float,
    medium: str,
    first_wanted: float = 0.0,
    last_wanted: float = np.inf,
) -> Profiles:
    """Return the profiles of all emission lines that reach into a range of wavelengths, averaged over bins of 1 A.

    Parameters
    ----------
    fluxes : float array, shape (n, n_line)
        Flux of each line of `line_list` for each source, in erg s-1 cm-2. Lines with NaN, 0 or less are left out.
    z_obs : float array, shape (n,)
        Redshift of each source.
    sigma : float array, shape (n,)
        Velocity dispersion of each source in km/s.
    medium : str
        Medium of the wavelengths, "air" or "vacuum".
    first_wanted, last_wanted : float, optional
        Range of observed wavelengths in A.

    Returns
    -------
    Profiles
        One profile per source and line.

    Raises
    ------
    BadInput
        If the medium is unknown.

    Notes
    -----
    In the observed frame a line is a Gaussian of centre lambda_i = mu_i (1 + z) and width sigma / c lambda_i, whose
    integral is the flux. Serrano et al. 2024 (appendix B, eq. f_el) give the centre without redshift, and an additional
    factor 1 / (1 + z) in the exponent.

    The error of the shape is 2e-8 of the flux. The sum over the bins equals the flux within a fraction of 1e-14.
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


def add(spectra: _Spectra, first: int, lines: Profiles) -> _Spectra:
    """Add line profiles to spectra in place.

    Parameters
    ----------
    spectra : float array, shape (n, w)
        f_lambda of n sources in steps of 1 A. It is modified.
    first : int
        Wavelength of the first column of `spectra` in A.
    lines : Profiles
        Profiles of the lines of these sources. Bins outside the spectra are ignored.

    Returns
    -------
    float array, shape (n, w)
        The array `spectra` itself.
    """
    _add_profiles(spectra, lines.first - first, lines.row, lines.f_lambda)
    return spectra


@exact_jit
def _add_profiles(spectra: _Spectra, start: Int, row: Int, profiles: Float) -> None:
    """Add m profiles [m, w] to the rows `row` [m] of spectra, from the columns `start` [m] on."""
    for m in range(len(row)):
        spectrum, profile = spectra[row[m]], profiles[m]
        for i in range(max(0, -start[m]), min(len(profile), len(spectrum) - start[m])):
            spectrum[start[m] + i] += profile[i]
