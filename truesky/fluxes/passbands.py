"""Load passbands on the common wavelength grid, and convert spectra to fluxes.

The observed-frame grid of all spectra is 600 to 24000 A in steps of 1 A. passbands.csv lists the built-in passbands.
"""

from __future__ import annotations

import csv
import importlib.metadata
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.units import LIGHT_ANGSTROM_S
from truesky.numerics import cache, matrices
from truesky.numerics.code_fingerprints import code_key

# First and last wavelength of the common grid, A. Serrano et al. 2024, appendix B, resample every spectrum and response
# to this range in steps of 1 A.
GRID_FIRST, GRID_LAST = 600, 24000
# Each end of a passband is cut so that this fraction of the photons of a source with constant f_lambda is lost. Small
# responses between the ends are kept: with much dust, the red leak of an ultraviolet band has most of the flux.
END_PHOTON_FRACTION = 1e-7
# Extent of a logistic edge of a band in units of its width; exp(-20) is negligible.
_LOGISTIC_REACH = 20.0

TABLE = Path(__file__).with_suffix(".csv")


@dataclass(frozen=True, slots=True, eq=False)
class Passband:
    """Photon response of a telescope, filter and detector, as a function of wavelength.

    Passbands are immutable, and are equal only if they are the same object.

    Attributes
    ----------
    name : str
        Name of the passband.
    wavelength : float array, shape (n,)
        Wavelengths in A, whole numbers in steps of 1 between 600 and 24000, in the band's medium.
    response : float array, shape (n,)
        Detected photons per arriving photon. Some published curves have an arbitrary scale.
    medium : str
        "air" (from the ground) or "vacuum" (from space). It sets the observed wavelengths of emission lines.
    """

    name: str
    wavelength: Float
    response: Float
    medium: str

    @property
    def first(self) -> int:
        """Return the index of the band's first wavelength on the grid of `grid()`."""
        return int(self.wavelength[0]) - GRID_FIRST


def grid() -> Float:
    """Return the observed-frame wavelength grid, 600 to 24000 A in steps of 1 A: float64[23401]."""
    return np.arange(GRID_FIRST, GRID_LAST + 1, dtype=float)


def names() -> tuple[str, ...]:
    """Return the names of all built-in passbands, in the order of passbands.csv."""
    return tuple(_rows())


def load(name: str) -> Passband:
    """Return a built-in passband by name, resampled to steps of 1 A; raises BadInput if the name is unknown."""
    rows = _rows()
    if name not in rows:
        raise BadInput(f"passband {name!r} is not one of {', '.join(rows)}")
    return _load(name, tuple(rows[name].items()))


@lru_cache(maxsize=64)
def _load(name: str, items: tuple[tuple[str, str], ...]) -> Passband:
    row = dict(items)
    key = cache.content_key(code_key(__name__), repr(row), _speclite_version())
    arrays = cache.cached_arrays(f"passband_{name}", key, lambda: _curve(row["source"], float(row["shift"])))
    return Passband(name, arrays["wavelength"], arrays["response"], row["medium"])


def provenance(name: str) -> tuple[str, str]:
    """Return two columns of passbands.csv for a built-in passband: the source of its curve, and a note.

    The source is "speclite:NAME" for a curve of the package speclite, or "logistic:..." with the parameters of a
    top hat with logistic edges. Raises KeyError if the name is unknown.
    """
    row = _rows()[name]
    return row["source"], row["note"]


def weights(band: Passband) -> Float:
    """Return weights, float64[n], such that the band-averaged f_nu is weights @ f_lambda(band.wavelength).

    f_nu is in erg s-1 cm-2 Hz-1 for f_lambda in erg s-1 cm-2 A-1.

    Notes
    -----
    The band-averaged flux is::

        f_nu = (int f_lambda R lambda dlambda / c) / (int R dlambda / lambda)

    References
    ----------
    Serrano et al. 2024, appendix B, eq. f_nu.
    """
    photons = band.response * band.wavelength
    return photons / (LIGHT_ANGSTROM_S * float(np.sum(band.response / band.wavelength)))


def log_width(band: Passband) -> float:
    """Return the integral of the response R over ln(lambda), without unit.

    `lake_schema.units.electron_rate` uses it to convert f_nu to detected photons.
    """
    return float(np.sum(band.response / band.wavelength))


def pivot_wavelength(band: Passband) -> float:
    """Return the pivot wavelength in A, sqrt(int R lambda dlambda / int R dlambda / lambda).

    At this wavelength, band averages obey f_nu = f_lambda lambda^2 / c.
    """
    return float(np.sqrt(np.sum(band.response * band.wavelength) / np.sum(band.response / band.wavelength)))


def ab_flux(band: Passband, wavelength: npt.ArrayLike, f_lambda: npt.ArrayLike) -> Float:
    """Return the band-averaged f_nu of spectra on any grid that covers the band.

    Parameters
    ----------
    band : Passband
        The passband.
    wavelength : float array, shape (m,)
        Wavelengths in A, increasing.
    f_lambda : float array, shape (..., m)
        Spectra in erg s-1 cm-2 A-1.

    Returns
    -------
    float array, shape (...)
        f_nu in erg s-1 cm-2 Hz-1.

    Raises
    ------
    BadInput
        If the spectra do not cover the band.
    """
    at = np.asarray(wavelength, float)
    spectra = np.asarray(f_lambda, float)
    if at[0] > band.wavelength[0] or at[-1] < band.wavelength[-1]:
        raise BadInput(f"spectrum {at[0]:g}-{at[-1]:g} A does not cover passband {band.name}")
    index = np.clip(np.searchsorted(at, band.wavelength, "right") - 1, 0, len(at) - 2)
    fraction = (band.wavelength - at[index]) / (at[index + 1] - at[index])
    interpolated = spectra[..., index] * (1.0 - fraction) + spectra[..., index + 1] * fraction
    return np.asarray(matrices.matmul(interpolated, weights(band)))


@lru_cache
def _speclite_version() -> str:
    return importlib.metadata.version("speclite")


def _rows() -> dict[str, dict[str, str]]:
    by_name: dict[str, dict[str, str]] = {}
    with TABLE.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            if row["name"] in by_name:
                raise BadInput(f"{TABLE.name}: passband {row['name']} occurs twice: choose another name")
            by_name[row["name"]] = row
    return by_name


def _curve(source: str, shift: float) -> dict[str, Float]:
    """Compute the response of a built-in passband on whole angstroms, from its columns in passbands.csv.

    `source` is "speclite:NAME" or "logistic:BLUE:RED:WIDTH:PEAK". A `shift` above 1 moves the band to the blue:
    R_new(lambda) = R(shift lambda).
    """
    kind, _, detail = source.partition(":")
    wavelength, response = _speclite_curve(detail) if kind == "speclite" else _logistic(detail)
    angstroms, resampled_response = resample_to_grid(wavelength / shift, response)
    return {"wavelength": angstroms, "response": resampled_response}


def resample_to_grid(wavelength: Float, response: Float) -> tuple[Float, Float]:
    """Resample a passband linearly to whole angstroms from 600 to 24000 A, and cut its negligible ends.

    Parameters
    ----------
    wavelength : float array, shape (m,)
        Wavelengths in A, increasing.
    response : float array, shape (m,)
        Response per photon.

    Returns
    -------
    wavelength, response : float array, shape (n,)
        The resampled curve, without `END_PHOTON_FRACTION` of the photons at each end. Both are empty if the curve
        contains no whole angstrom of the grid.
    """
    angstroms = np.arange(np.ceil(wavelength[0]), np.floor(wavelength[-1]) + 1.0)
    angstroms = angstroms[(angstroms >= GRID_FIRST) & (angstroms <= GRID_LAST)]
    if not len(angstroms):
        return angstroms, angstroms
    at_angstroms = np.interp(angstroms, wavelength, response)
    photons = np.cumsum(at_angstroms * angstroms)
    first, last = np.searchsorted(photons, np.array([END_PHOTON_FRACTION, 1.0 - END_PHOTON_FRACTION]) * photons[-1])
    return angstroms[first : last + 1], at_angstroms[first : last + 1]


def _speclite_curve(name: str) -> tuple[Float, Float]:
    # Import here, because the import is slow, and needed only if a band is not in the disc cache.
    from speclite.filters import load_filter

    # `load_filter` returns wavelengths in A, although the files of speclite are in A, nm or um.
    response = load_filter(name)
    return np.asarray(response.wavelength, float), np.clip(np.asarray(response.response, float), 0.0, None)


def _logistic(detail: str) -> tuple[Float, Float]:
    """Return wavelengths (A) and response of a top hat with logistic edges.

    `detail` is "BLUE:RED:WIDTH:PEAK": the positions of both edges and their width in A, and the peak response.
    """
    blue, red, width, peak = (float(part) for part in detail.split(":"))
    wavelength = np.arange(np.floor(blue - _LOGISTIC_REACH * width), np.ceil(red + _LOGISTIC_REACH * width) + 1.0)
    edges = 1.0 / ((1.0 + np.exp(-(wavelength - blue) / width)) * (1.0 + np.exp((wavelength - red) / width)))
    return wavelength, peak * edges
