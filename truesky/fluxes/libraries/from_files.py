"""Read template spectra, extinction curves and passbands from a user's files, and check them.

spectrum_formats.toml describes the formats. All errors are BadInput. Their messages name the file and, if there is one,
the row.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from lake_schema import user_files
from lake_schema.arrays import Bool, Float
from lake_schema.errors import BadInput, LakeError
from lake_schema.fits.external import read_table
from truesky.fluxes import passbands
from truesky.fluxes.libraries import text_tables, votable
from truesky.fluxes.libraries.stellar import normalise
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.passbands import Passband

_FORMATS = Path(__file__).with_name("spectrum_formats.toml")
# Attribute of a VOTable with the number of rows. It is removed, because astropy would allocate memory for this number.
_ROW_COUNT = re.compile(r"""\bnrows\s*=\s*["'][^"']*["']""")
# Angstrom per unit of wavelength.
ANGSTROM = {"Angstrom": 1.0, "nm": 10.0, "um": 1e4}
# Exponent of f_lambda (a power of lambda) beyond the red end of a galaxy spectrum from a file.
_RED_SLOPE = -3.2

# Largest k = A / E(B-V) that is accepted in an extinction law; the steepest law has about 25 at 912 A.
_MAX_EXTINCTION = 100.0
# Largest fraction of the photons that a passband may detect at wavelengths without spectra.
_MAX_LOST_PHOTONS = 1e-3


@dataclass(frozen=True, slots=True)
class Curve:
    """A spectrum, extinction curve or passband as in a file.

    Attributes
    ----------
    wavelength : float array, shape (n,)
        Wavelengths in A, increasing.
    value : float array, shape (n,)
        f_lambda, k = A / E(B-V) or response at these wavelengths, 0 or more.
    """

    wavelength: Float
    value: Float


def formats() -> Mapping[str, Mapping[str, Any]]:
    """Return the file formats by name, as in spectrum_formats.toml: reader, columns, unit, limits of wavelengths."""
    return user_files.parse_toml(_FORMATS.read_text(encoding="utf-8"))


def read(path: Path, format_name: str) -> Curve:
    """Read a curve from a file.

    Parameters
    ----------
    path : Path
        The file.
    format_name : str
        Name of its format, one of the keys of `formats()`.

    Returns
    -------
    Curve
        Wavelengths, converted to A, and values.

    Raises
    ------
    BadInput
        If the format is unknown, the file is absent, too large or in another format, or the curve is not valid
        (see `check_curve`).
    """
    all_formats = formats()
    if format_name not in all_formats:
        raise BadInput(f"format {format_name!r} is not one of {', '.join(all_formats)}")
    form = all_formats[format_name]
    try:
        wavelength, value = _columns(path, form)
    except LakeError:
        raise
    except Exception as error:
        # Catch all errors, because the readers of astropy and NumPy raise many types for a wrong file.
        raise BadInput(f"{path}: cannot be read as {format_name}: {' '.join(str(error).split())[:200]}") from None
    check_curve(path, wavelength, value, form)
    return Curve(wavelength, value)


def library(files: Sequence[Path], format_name: str = "cosmos") -> Library:
    """Read galaxy templates from files, and resample them to 80 to 24500 A in steps of 1 A.

    Parameters
    ----------
    files : sequence of Path
        At least one file. Each has one template, in order of galaxy type, elliptical first.
    format_name : str, optional
        Format of the files, one of the keys of `formats()`.

    Returns
    -------
    Library
        Templates whose mean f_lambda is 1 between 5450 and 5550 A. They are named after the files.

    Raises
    ------
    BadInput
        If a file cannot be read or its spectrum is not valid.

    Notes
    -----
    Each bin of 1 A gets the mean of the file's spectrum over the bin, which conserves flux. The flux is 0 beyond the
    blue end of a file, and proportional to lambda^-3.2 beyond its red end.
    """
    from truesky.fluxes.libraries.rest_grid import rest_grid

    grid = rest_grid()
    flux = np.stack([resample(grid, read(path, format_name)) for path in files])
    names = tuple(path.stem for path in files)
    return Library(grid, normalise(grid, flux).astype(np.float32), names, external=True)


def law(path: Path, format_name: str, wavelength: Float) -> Float:
    """Read an extinction law k(lambda) = A / E(B-V) from a file.

    Parameters
    ----------
    path : Path
        The file.
    format_name : str
        Format of the file, one of the keys of `formats()`.
    wavelength : float array, shape (n,)
        Wavelengths in A at which the law is needed.

    Returns
    -------
    float array, shape (n,)
        k at these wavelengths, interpolated linearly, and constant beyond the wavelengths of the file.

    Raises
    ------
    BadInput
        If the file cannot be read, its curve is not valid, or a value is above 100.
    """
    curve = read(path, format_name)
    _refuse(path, curve.value > _MAX_EXTINCTION, f"is more than k = {_MAX_EXTINCTION:g}: the values must be A / E(B-V)")
    return np.interp(wavelength, curve.wavelength, curve.value)


def passband(path: Path, name: str, medium: str, form: str = "passband_ascii") -> Passband:
    """Read a passband from a file.

    Parameters
    ----------
    path : Path
        The file.
    name : str
        Name that the passband gets.
    medium : str
        Medium of the wavelengths, "air" or "vacuum".
    form : str, optional
        Format of the file, one of the keys of `formats()`.

    Returns
    -------
    Passband
        The passband, resampled to steps of 1 A.

    Raises
    ------
    BadInput
        If the medium is unknown, the file cannot be read, or the curve is not valid, detects more than
        `_MAX_LOST_PHOTONS` of its photons outside 600 to 24000 A, or is 0 at all whole angstroms.
    """
    if medium not in ("air", "vacuum"):
        raise BadInput(f"{path}: medium {medium!r} is not air or vacuum")
    curve = read(path, form)
    wavelength, response = passbands.resample_to_grid(curve.wavelength, curve.value)
    if not len(wavelength):
        first, last = passbands.GRID_FIRST, passbands.GRID_LAST
        raise BadInput(f"{path}: the passband is outside {first} .. {last} A, or between two whole angstroms")
    if not response.any():
        raise BadInput(f"{path}: the passband is 0 at all whole angstroms: it must be wider than 1 A")
    lost = _lost_photons(curve)
    if lost > _MAX_LOST_PHOTONS:
        first, last = passbands.GRID_FIRST, passbands.GRID_LAST
        problem = f"detects {lost:.1%} of its photons outside {first} .. {last} A, where there are no spectra"
        raise BadInput(f"{path}: {problem}: cut the curve there, or leave out the band")
    return Passband(name, wavelength, response, medium)


def _lost_photons(curve: Curve) -> float:
    """Return the fraction of a passband's photons beyond the grid of spectra, for a source of constant f_lambda."""
    edges = np.clip([passbands.GRID_FIRST, passbands.GRID_LAST], curve.wavelength[0], curve.wavelength[-1])
    # The edges become points of the curve, so that trapezoids end there.
    wavelength = np.union1d(curve.wavelength, edges)
    photons = np.interp(wavelength, curve.wavelength, curve.value) * wavelength
    each = 0.5 * (photons[1:] + photons[:-1]) * np.diff(wavelength)
    inside = (wavelength[:-1] >= edges[0]) & (wavelength[1:] <= edges[1])
    return float(each[~inside].sum() / each.sum())


def _columns(path: Path, form: Mapping[str, Any]) -> tuple[Float, Float]:
    """Read the wavelengths (converted to A) and values of a curve from a file of the given format, unchecked."""
    reader, names = form["reader"], (form["wavelength"], form["value"])
    scale = ANGSTROM[form["unit"]]
    if reader == "ascii":
        lines = user_files.read_text(path, "curve").splitlines()
        if not any(line.partition("#")[0].strip() for line in lines):
            raise BadInput(f"{path}: has no rows")
        rows = np.loadtxt(lines, comments="#", usecols=[names[0] - 1, names[1] - 1], ndmin=2)
        return rows[:, 0] * scale, rows[:, 1]
    # Import here, because the import is slow and plain text files do not need it.
    from astropy.units import Quantity, dimensionless_unscaled

    table = read_table(path, "curve") if reader == "fits" else _table(path, reader)
    wavelength, value = (table[name] for name in names)
    if isinstance(wavelength, Quantity) and wavelength.unit != dimensionless_unscaled:
        wavelength, scale = wavelength.to_value("Angstrom"), 1.0
    return _without_unit(wavelength) * scale, _without_unit(value)


def _table(path: Path, reader: str) -> Any:
    """Read a VOTable (reader "votable") or a text table (reader of astropy, such as "ecsv") as an astropy table.

    Astropy gets the text and not the path, since it would unpack a compressed file or download from an address.
    """
    from astropy.table import QTable

    text = user_files.read_text(path, "table of a curve")
    if reader != "votable":
        lines = text.splitlines()
        text_tables.refuse_large(lines, has_header=reader == "ecsv")
        return QTable.read(lines, format=f"ascii.{reader}", guess=False)
    votable.refuse_large(text)
    return QTable.read(BytesIO(_ROW_COUNT.sub("", text).encode()), format="votable")


def _without_unit(column: Any) -> Float:
    """Return a table column as float64 without its unit; masked values become NaN, which `check_curve` refuses."""
    bare = getattr(column, "value", column)
    return np.asarray(np.ma.filled(np.ma.asarray(bare, dtype=float), np.nan), float)


def check_curve(path: Path, wavelength: Float, value: Float, form: Mapping[str, Any]) -> None:
    """Check that wavelengths and values form a valid curve.

    Parameters
    ----------
    path : Path
        File of the curve, for error messages. It is not read.
    wavelength, value : float array, shape (n,)
        Wavelengths in A, and values.
    form : mapping of str to object
        Limits: `bounds`, the first and last allowed wavelength (A); `largest_gap`, the largest step in ln(wavelength);
        and optionally `covers`, the range (A) that the curve must contain.

    Raises
    ------
    BadInput
        If there are fewer than two rows; if a number is missing, infinite or negative; if wavelengths are repeated,
        decreasing, out of bounds, do not cover the range or have a gap; or if all values are 0. The message names the
        file and the row.
    """
    lo, hi = form["bounds"]
    if wavelength.ndim != 1 or wavelength.shape != value.shape:
        raise BadInput(f"{path}: {list(wavelength.shape)} wavelengths and {list(value.shape)} values are not a curve")
    if len(wavelength) < 2:
        raise BadInput(f"{path}: a curve must have at least 2 rows, got {len(wavelength)}")
    _refuse(path, ~(np.isfinite(wavelength) & np.isfinite(value)), "is not a number")
    _refuse(
        path, (wavelength < lo) | (wavelength > hi), f"wavelength is outside {lo:g} .. {hi:g} A: is the unit right?"
    )
    steps = np.diff(wavelength)
    _refuse(path, np.append(False, steps == 0.0), "repeats the wavelength")
    for row in np.flatnonzero(steps < 0.0)[:1].tolist():
        first, second = wavelength[row : row + 2].tolist()
        problem = f"wavelengths must increase, but row {row + 2} has {second:g} after {first:g} (A)"
        raise BadInput(f"{path}: {problem}")
    _refuse(path, value < 0.0, "is negative")
    if not value.any():
        raise BadInput(f"{path}: all values are 0")
    first, last = form.get("covers", (wavelength[0], wavelength[-1]))
    if wavelength[0] > first or wavelength[-1] < last:
        ends = f"{wavelength[0]:g} .. {wavelength[-1]:g}"
        raise BadInput(f"{path}: covers {ends} A, not {first:g} .. {last:g} A: is the unit right?")
    wide = (np.diff(np.log(wavelength)) > form["largest_gap"]) & (wavelength[1:] > first) & (wavelength[:-1] < last)
    for row in np.flatnonzero(wide)[:1].tolist():
        lower, upper = wavelength[row : row + 2].tolist()
        largest = lower * np.expm1(form["largest_gap"])
        problem = f"row {row + 2} ({upper:g} A) follows a gap of {upper - lower:g} A"
        raise BadInput(f"{path}: {problem}, but at most {largest:.4g} A is allowed there: add rows")


def _refuse(path: Path, bad: Bool, problem: str) -> None:
    if bad.any():
        raise BadInput(f"{path}: row {int(np.flatnonzero(bad)[0]) + 1} {problem}")


def resample(grid: Float, curve: Curve) -> Float:
    """Return the mean of a piecewise linear spectrum over bins of 1 A centred on `grid` (A), in the shape of `grid`.

    The mean is computed from the spectrum's integral. The spectrum is 0 beyond its blue end, and proportional to
    lambda^-3.2 beyond its red end.
    """
    at, value = curve.wavelength, curve.value
    if at[-1] < grid[-1] + 0.5:
        tail = np.arange(at[-1] + 1.0, grid[-1] + 2.0)
        at, value = np.append(at, tail), np.append(value, value[-1] * (tail / at[-1]) ** _RED_SLOPE)
    edges = np.append(grid, grid[-1] + 1.0) - 0.5
    # Add the edges of the bins to the samples, since the integral of a piecewise linear curve is exact at its samples.
    nodes = np.union1d(at, edges)
    sampled = np.interp(nodes, at, value, left=0.0)
    integral = np.append(0.0, np.cumsum(0.5 * (sampled[1:] + sampled[:-1]) * np.diff(nodes)))
    return np.diff(np.interp(edges, nodes, integral))
