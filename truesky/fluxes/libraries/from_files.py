"""Spectra, extinction curves and passbands from external files: checked, named, never guessed.

formats         what can be read (spectrum_formats.toml)
read            wavelengths and values of one file
library         galaxy templates on our grid, from files in the order of a list
law             an extinction law on the wavelengths of a library
passband        a user's filter
check, resampled   what they are read with

Every refusal is a BadInput that names the file, and the row where there is one.
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
# Of a VOTable; room would be made for as many rows.
_ROW_COUNT = re.compile(r"""\bnrows\s*=\s*["'][^"']*["']""")
ANGSTROM = {"Angstrom": 1.0, "nm": 10.0, "um": 1e4}
# f_lambda beyond the red end of a file of galaxies.
_RED_SLOPE = -3.2

# k of the steepest law, at 912 A, is some 25.
_MAX_EXTINCTION = 100.0


@dataclass(frozen=True, slots=True)
class Curve:
    """wavelength : float64[n] A, ascending;  value : float64[n] >= 0."""

    wavelength: Float
    value: Float


def formats() -> Mapping[str, Mapping[str, Any]]:
    """The formats by name."""
    return user_files.parse_toml(_FORMATS.read_text(encoding="utf-8"))


def read(path: Path, format_name: str) -> Curve:
    """A file in one of the `formats`.

    Errors: BadInput for a file that is absent, too large or not of that form; one row; wavelengths not ascending,
            repeated or in another unit; negative, infinite or missing values; nothing but zeros; a gap
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
        # What the libraries' readers raise of a user's file has no end.
        raise BadInput(f"{path}: cannot be read as {format_name}: {' '.join(str(error).split())[:200]}") from None
    check_curve(path, wavelength, value, form)
    return Curve(wavelength, value)


def library(files: Sequence[Path], format_name: str = "cosmos") -> Library:
    """Galaxy templates from files, earliest first, on the rest-frame grid of the embedded library, normalised.

    Each bin of 1 A gets the mean of the file's spectrum over it: flux is conserved. Without flux beyond the blue end;
    beyond the red end as lambda^-3.2.
    """
    from truesky.fluxes.libraries.rest_grid import rest_grid

    grid = rest_grid()
    flux = np.stack([resample(grid, read(path, format_name)) for path in files])
    names = tuple(path.stem for path in files)
    return Library(grid, normalise(grid, flux).astype(np.float32), names, external=True)


def law(path: Path, format_name: str, wavelength: Float) -> Float:
    """k(lambda) = A / E(B-V) of an extinction law, linear between the file's wavelengths, constant beyond them."""
    curve = read(path, format_name)
    _refuse(path, curve.value > _MAX_EXTINCTION, f"is more than k = {_MAX_EXTINCTION:g}: is it A / E(B-V)?")
    return np.interp(wavelength, curve.wavelength, curve.value)


def passband(path: Path, name: str, medium: str, form: str = "passband_ascii") -> Passband:
    """A user's filter, to be given in place of a passband's name; medium is "air" or "vacuum".

    path : of the file;  name : that it is to have;  form : one of spectrum_formats.toml
    """
    if medium not in ("air", "vacuum"):
        raise BadInput(f"{path}: medium {medium!r} is not air or vacuum")
    curve = read(path, form)
    wavelength, response = passbands.resample_to_grid(curve.wavelength, curve.value)
    if not len(wavelength):
        first, last = passbands.GRID_FIRST, passbands.GRID_LAST
        raise BadInput(f"{path}: lies outside {first} .. {last} A")
    return Passband(name, wavelength, response, medium)


def _columns(path: Path, form: Mapping[str, Any]) -> tuple[Float, Float]:
    """Wavelengths, A, and values, as the file has them."""
    reader, names = form["reader"], (form["wavelength"], form["value"])
    scale = ANGSTROM[form["unit"]]
    if reader == "ascii":
        lines = user_files.read_text(path, "curve").splitlines()
        if not any(line.partition("#")[0].strip() for line in lines):
            raise BadInput(f"{path}: has no rows")
        rows = np.loadtxt(lines, comments="#", usecols=[names[0] - 1, names[1] - 1], ndmin=2)
        return rows[:, 0] * scale, rows[:, 1]
    # Slow to import, and not needed for the form that most files have.
    from astropy.units import Quantity, dimensionless_unscaled

    table = read_table(path, "curve") if reader == "fits" else _table(path, reader)
    wavelength, value = (table[name] for name in names)
    if isinstance(wavelength, Quantity) and wavelength.unit != dimensionless_unscaled:
        wavelength, scale = wavelength.to_value("Angstrom"), 1.0
    return _without_unit(wavelength) * scale, _without_unit(value)


def _table(path: Path, reader: str) -> Any:
    """An astropy table of a text file; given to astropy as text, for a path it would unpack, or fetch."""
    from astropy.table import QTable

    text = user_files.read_text(path, "table of a curve")
    if reader != "votable":
        lines = text.splitlines()
        text_tables.refuse_large(lines, has_header=reader == "ecsv")
        return QTable.read(lines, format=f"ascii.{reader}", guess=False)
    votable.refuse_large(text)
    return QTable.read(BytesIO(_ROW_COUNT.sub("", text).encode()), format="votable")


def _without_unit(column: Any) -> Float:
    """A column without its unit; what is masked becomes NaN, to be refused."""
    bare = getattr(column, "value", column)
    return np.asarray(np.ma.filled(np.ma.asarray(bare, dtype=float), np.nan), float)


def check_curve(path: Path, wavelength: Float, value: Float, form: Mapping[str, Any]) -> None:
    """Refuse what is no curve, naming the row; form : bounds, largest_gap and covers as in the formats.

    path : named in the refusal;  wavelength, value : float[n] of the curve
    """
    lo, hi = form["bounds"]
    if wavelength.ndim != 1 or wavelength.shape != value.shape:
        raise BadInput(f"{path}: {list(wavelength.shape)} wavelengths and {list(value.shape)} values are no curve")
    if len(wavelength) < 2:
        raise BadInput(f"{path}: {len(wavelength)} rows are no curve")
    _refuse(path, ~(np.isfinite(wavelength) & np.isfinite(value)), "is not a number")
    _refuse(
        path, (wavelength < lo) | (wavelength > hi), f"wavelength is outside {lo:g} .. {hi:g} A: is the unit right?"
    )
    steps = np.diff(wavelength)
    _refuse(path, np.append(False, steps == 0.0), "repeats the wavelength")
    _refuse(path, np.append(False, steps < 0.0), "goes back in wavelength")
    _refuse(path, value < 0.0, "is negative")
    if not value.any():
        raise BadInput(f"{path}: all values are 0")
    first, last = form.get("covers", (wavelength[0], wavelength[-1]))
    if wavelength[0] > first or wavelength[-1] < last:
        ends = f"{wavelength[0]:g} .. {wavelength[-1]:g}"
        raise BadInput(f"{path}: covers {ends} A, not {first:g} .. {last:g} A: is the unit right?")
    wide = (np.diff(np.log(wavelength)) > form["largest_gap"]) & (wavelength[1:] > first) & (wavelength[:-1] < last)
    _refuse(path, np.append(False, wide), "follows a gap")


def _refuse(path: Path, bad: Bool, problem: str) -> None:
    if bad.any():
        raise BadInput(f"{path}: row {int(np.flatnonzero(bad)[0]) + 1} {problem}")


def resample(grid: Float, curve: Curve) -> Float:
    """Mean over each bin of 1 A, from the integral of the piecewise linear spectrum."""
    at, value = curve.wavelength, curve.value
    if at[-1] < grid[-1] + 0.5:
        tail = np.arange(at[-1] + 1.0, grid[-1] + 2.0)
        at, value = np.append(at, tail), np.append(value, value[-1] * (tail / at[-1]) ** _RED_SLOPE)
    edges = np.append(grid, grid[-1] + 1.0) - 0.5
    # The integral is exact where the spectrum is sampled; the edges of the bins are added to the samples.
    nodes = np.union1d(at, edges)
    sampled = np.interp(nodes, at, value, left=0.0)
    integral = np.append(0.0, np.cumsum(0.5 * (sampled[1:] + sampled[:-1]) * np.diff(nodes)))
    return np.diff(np.interp(edges, nodes, integral))
