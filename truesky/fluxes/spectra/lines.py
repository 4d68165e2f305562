"""Compute emission lines: their observed wavelengths, widths, and profiles on the grid.

lines.csv has the ten lines of Serrano et al. 2024, table "Emission lines", and ten more. A secondary line has a fixed
fraction of the flux of its primary line. The catalogue contains only the flux of the primary line.
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

# Serrano et al. 2024, appendix B: log10 sigma = (A + B z) (M_r - C) + D z. The upper bound is adopted, because the
# relation gives unrealistically large values for galaxies brighter than M_r = -23.
_SLOPE, _SLOPE_EVOLUTION, _MAGNITUDE_ZERO, _EVOLUTION = -0.10, 0.01, 3.0, -0.05
SIGMA_MIN, SIGMA_MAX = 50.0, 400.0

# Ciddor 1996, eq. 1: n - 1 of standard air (15 C, 101325 Pa, 450 ppm CO2) in 1e-8, wave numbers in 1/um.
_CIDDOR = ((5_792_105.0, 238.0185), (167_917.0, 57.362))

# Profiles are cut at this distance in sigma. The fraction 2e-8 of the flux outside is distributed over the rest.
_REACH = 5.6


@dataclass(frozen=True, slots=True)
class Line:
    """One emission line.

    Attributes
    ----------
    name : str
        Name of the line.
    column : str
        Column of the table `galaxies` with the flux of its primary line.
    ratio : float
        Flux relative to that column.
    vacuum, air : float
        Rest-frame wavelengths in A.
    source : str
        Source of these numbers.
    """

    name: str
    column: str
    ratio: float
    vacuum: float
    air: float
    source: str


@dataclass(frozen=True, slots=True)
class Profiles:
    """Flux of m lines in bins of 1 A.

    Attributes
    ----------
    row : int array, shape (m,)
        Row of the source with this line.
    first : int array, shape (m,)
        Wavelength of the centre of the first bin in A.
    f_lambda : float array, shape (m, w)
        Mean f_lambda in each bin.
    """

    row: Int
    first: Int
    f_lambda: Float


@cache
def line_list() -> tuple[Line, ...]:
    """Return all lines, primary lines before their secondary lines."""
    with TABLE.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return tuple(
        Line(row["name"], row["column"], float(row["ratio"]), float(row["vacuum"]), float(row["air"]), row["source"])
        for row in rows
    )


def columns() -> tuple[str, ...]:
    """Return the columns of the table `galaxies` with line fluxes."""
    return tuple(dict.fromkeys(line.column for line in line_list()))


def width_law() -> dict[str, float]:
    """Return the parameters of `velocity_dispersion` by their names in the table `emission_lines`."""
    names = ("width_slope", "width_slope_z", "width_magnitude", "width_z", "width_least", "width_most")
    numbers = (_SLOPE, _SLOPE_EVOLUTION, _MAGNITUDE_ZERO, _EVOLUTION, SIGMA_MIN, SIGMA_MAX)
    return dict(zip(names, numbers, strict=True))


def velocity_dispersion(abs_mag_r01: npt.ArrayLike, z_obs: npt.ArrayLike) -> Float:
    """Return the Gaussian sigma of the lines in km/s, 50 to 400.

    Parameters
    ----------
    abs_mag_r01 : array_like
        Absolute magnitude M(0.1r) - 5 log10 h.
    z_obs : array_like
        Redshift.

    Returns
    -------
    float array
        Velocity dispersion in km/s.

    References
    ----------
    Serrano et al. 2024, appendix B, eq. sigma_el.
    """
    mag, z = np.asarray(abs_mag_r01, float), np.asarray(z_obs, float)
    log_sigma = (_SLOPE + _SLOPE_EVOLUTION * z) * (mag - _MAGNITUDE_ZERO) + _EVOLUTION * z
    return np.asarray(np.clip(10.0 ** np.clip(log_sigma, -300.0, 300.0), SIGMA_MIN, SIGMA_MAX))


def air_wavelength(vacuum: npt.ArrayLike) -> Float:
    """Return the wavelength in standard air for a vacuum wavelength, both in A and above 2000 A.

    References
    ----------
    Ciddor 1996, eq. 1.
    """
    lam = np.asarray(vacuum, float)
    square = (1e4 / lam) ** 2
    refractivity = 1e-8 * sum(strength / (resonance - square) for strength, resonance in _CIDDOR)
    return np.asarray(lam / (1.0 + refractivity))


def observed_wavelength(vacuum: npt.ArrayLike, z_obs: npt.ArrayLike, medium: str) -> Float:
    """Return the observed wavelength of a line.

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
    float array
        Observed wavelength in A. Air refracts at the observed wavelength, not at the emitted wavelength.

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
    """Return (strength, resonance) of the two terms of `air_wavelength`, float64[2, 2]."""
    return np.array(_CIDDOR)


def profiles(
    fluxes: Float,
    z_obs: Float,
    sigma: Float,
    medium: str,
    first_wanted: float = 0.0,
    last_wanted: float = np.inf,
) -> Profiles:
    """Return the profiles of lines that reach into a range of wavelengths, integrated over bins of 1 A.

    Parameters
    ----------
    fluxes : float array, shape (n, n_line)
        Observed flux of each line of `line_list` in erg s-1 cm-2; NaN or 0 without a line.
    z_obs : float array, shape (n,)
        Redshifts.
    sigma : float array, shape (n,)
        Velocity dispersions in km/s.
    medium : str
        Medium of the wavelengths, "air" or "vacuum".
    first_wanted, last_wanted : float, optional
        Range of observed wavelengths in A.

    Returns
    -------
    Profiles
        The profiles.

    Notes
    -----
    In the observed frame a line is a Gaussian of centre lambda_i = mu_i (1 + z) and width sigma / c lambda_i, whose
    integral is the flux. Serrano et al. 2024 (appendix B, eq. f_el) give the centre without redshift, and an additional
    factor 1 / (1 + z) in the exponent.

    The error of the shape is 2e-8 of the flux. The bins sum to the flux within 1e-14.
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
    """Add line profiles to spectra in place.

    Parameters
    ----------
    spectra : float array, shape (n, w)
        f_lambda in steps of 1 A. It is modified.
    first : int
        Wavelength of the first column of `spectra` in A.
    lines : Profiles
        Profiles of lines.

    Returns
    -------
    float array, shape (n, w)
        `spectra`.
    """
    index = lines.first[:, None] - first + np.arange(lines.f_lambda.shape[1])
    inside = (index >= 0) & (index < spectra.shape[1])
    row = np.broadcast_to(lines.row[:, None], index.shape)
    # Two lines of a galaxy may be in the same bin, which += would add only once.
    np.add.at(spectra, (row[inside], index[inside]), lines.f_lambda[inside])
    return spectra
