"""Read a user's spectral series of type Ia supernovae, which replaces the built-in one."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.external import files
from lake_schema.store.provenance import file_sha256
from truesky.fluxes import passbands
from truesky.variability import supernova_templates
from truesky.variability.supernova_templates import PEAK_BAND, TYPE_IA, Template

COLUMNS = ("phase", "wavelength", "flux")
# Key of the file in the facts of the table `transients`.
_KEY = "light_curves"
# Largest number of points of a series, and largest number of wavelengths after resampling.
_MAX_POINTS, _MAX_WAVELENGTHS = 5_000_000, 50_000
# Largest step of wavelengths after resampling, A; a larger one is divided. Dust is computed at these wavelengths: 25 A
# give fluxes right within 3e-5 for A(V) = 1.
_LARGEST_STEP = 25.0
# Longest time before and after the peak, days.
_MAX_PHASE = 2000.0


def facts(path: Path | None) -> dict[str, Any]:
    """Return the path and the checksum of the user's file, to be recorded with a table; {} without a file."""
    if path is None:
        return {}
    path = path.resolve()
    sha256 = _checksum(path)
    _read_known(path, sha256)
    return {_KEY: {"path": str(path), "sha256": sha256}}


def _checksum(path: Path) -> str:
    try:
        return file_sha256(path)
    except OSError as error:
        problem = error.strerror or "cannot be read"
        raise BadInput(f"universe.transients.light_curves: {path}: {problem}") from None


@lru_cache(maxsize=2)
def _read_known(path: Path, sha256: str) -> Template:
    """Return the series in a file with this checksum, which is kept in memory."""
    return read(path)


def templates_from_facts(recorded: Mapping[str, Any]) -> Mapping[int, Template]:
    """Return the spectra by kind with which the table `transients` was made.

    Parameters
    ----------
    recorded : mapping
        Facts of the table, with the path and the checksum of the user's file if there is one.

    Returns
    -------
    mapping of int to Template
        Spectra by code of the kind.

    Raises
    ------
    BadInput
        If the user's file is invalid, or has changed since the facts were recorded.
    """
    if _KEY not in recorded:
        return supernova_templates.templates()
    path, sha256 = Path(recorded[_KEY]["path"]), recorded[_KEY]["sha256"]
    if _checksum(path) != sha256:
        raise BadInput(f"{path}: has changed since the transients were drawn: run truesky transients again")
    return {**supernova_templates.templates(), TYPE_IA: _read_known(path, sha256)}


def read(path: Path) -> Template:
    """Read a spectral series from a Parquet file.

    Parameters
    ----------
    path : Path
        File with one row per phase (days in the rest frame from any moment) and wavelength (A, rest frame), and the
        flux f_lambda on any scale, in columns of these names.

    Returns
    -------
    Template
        The series, whose phase 0 is the peak in the rest-frame band `PEAK_BAND`.

    Raises
    ------
    BadInput
        If the file cannot be read, a number is not finite, a flux is negative, a phase lacks a wavelength that others
        have, a pair of them occurs twice, or the wavelengths do not cover `PEAK_BAND`.
    """
    batches = list(files.read_batches(path, COLUMNS))
    if sum(len(batch) for batch in batches) > _MAX_POINTS:
        raise BadInput(f"{path}: has more than {_MAX_POINTS} rows")
    phase, wavelength, flux = (
        np.concatenate([np.zeros(0), *(batch[name].to_numpy(zero_copy_only=False).astype(float) for batch in batches)])
        for name in COLUMNS
    )
    for name, values, smallest in (("phase", phase, -_MAX_PHASE), ("wavelength", wavelength, 1.0), ("flux", flux, 0.0)):
        largest = _MAX_PHASE if name == "phase" else np.inf if name == "flux" else 1e6
        bad = ~((values >= smallest) & (values <= largest) & np.isfinite(values))
        if bad.any():
            row = int(np.argmax(bad))
            raise BadInput(
                f"{path}, row {row}: {name} = {values[row]:g} is not a number from {smallest:g} to {largest:g}"
            )
    return supernova_templates.normalise_template(*_equal_steps(path, *_as_grid(path, phase, wavelength, flux)))


def _as_grid(path: Path, phase: Float, wavelength: Float, flux: Float) -> tuple[Float, Float, Float]:
    """Return distinct phases, distinct wavelengths, and the fluxes as an array of both."""
    phases, wavelengths = np.unique(phase), np.unique(wavelength)
    if len(phases) < 2 or len(wavelengths) < 2:
        raise BadInput(f"{path}: needs at least two phases and two wavelengths")
    place = np.searchsorted(phases, phase) * len(wavelengths) + np.searchsorted(wavelengths, wavelength)
    counts = np.bincount(place, minlength=len(phases) * len(wavelengths))
    if (counts != 1).any():
        first = int(np.argmax(counts != 1))
        problem = "lacks the row of" if counts[first] == 0 else "has more than one row of"
        at = f"phase {phases[first // len(wavelengths)]:g}, wavelength {wavelengths[first % len(wavelengths)]:g}"
        raise BadInput(f"{path}: {problem} {at}: every phase must have the same wavelengths, once")
    grid = np.empty(len(phases) * len(wavelengths))
    grid[place] = flux
    return phases, wavelengths, grid.reshape(len(phases), len(wavelengths))


def _equal_steps(path: Path, phase: Float, wavelength: Float, flux: Float) -> tuple[Float, Float, Float]:
    """Return a series at wavelengths in equal steps: the smallest step of the file, divided if it is large."""
    band = passbands.load(PEAK_BAND)
    if wavelength[0] > band.wavelength[0] or wavelength[-1] < band.wavelength[-1]:
        covered, band_range = (f"{edges[0]:g} to {edges[-1]:g} A" for edges in (wavelength, band.wavelength))
        raise BadInput(f"{path}: wavelengths {covered} do not cover {PEAK_BAND}, {band_range}")
    if not (flux.sum(axis=1) > 0.0).any():
        raise BadInput(f"{path}: flux is 0 everywhere")
    smallest = float(np.diff(wavelength).min())
    step = smallest / np.ceil(smallest / _LARGEST_STEP)
    count = round((wavelength[-1] - wavelength[0]) / step) + 1
    if count > _MAX_WAVELENGTHS:
        raise BadInput(f"{path}: steps of wavelength are so small that {count} are needed, at most {_MAX_WAVELENGTHS}")
    even = np.linspace(wavelength[0], wavelength[-1], count)
    return phase, even, np.stack([np.interp(even, wavelength, row) for row in flux])
