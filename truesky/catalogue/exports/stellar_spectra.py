"""Spectra of stars as skyCatalogs reads them: a text file a template, and the magnitude that each star scales it to.

write       seds/star_K.txt, a line each 1 nm: wavelength nm, f_lambda
file_of     its path below the folder that SIMS_SED_LIBRARY_DIR names
magnorm     AB magnitude of each star at 500 nm, before extinction
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from lake_schema import units, user_files
from lake_schema.arrays import Float
from lake_schema.units import LIGHT_ANGSTROM_S
from truesky.fluxes.calibration import star_scale
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.sources import stars_from_table

# Samples of a template, 1 A apart, that make one of the file; where its level is taken, A.
_SAMPLES_PER_BIN, _LEVEL_WAVELENGTH = 10, 5000.0
# Of a template's highest sample, the least that a sample is.
_MIN_RELATIVE_FLUX = 1e-12


def relative_path(sed: int) -> str:
    """The path of a template's file."""
    return f"seds/star_{sed:03d}.txt"


def write(folder: Path, library: Library, templates: Sequence[int]) -> list[Path]:
    """Write some templates of a library, each replaced in one rename; returns the files."""
    wavelength, flux = _rebin(library)
    (folder / "seds").mkdir(exist_ok=True)
    written = []
    for k in templates:
        path = folder / relative_path(k)
        lines = (f"{at:.1f} {value:.7e}" for at, value in zip(wavelength / 10.0, flux[k], strict=True))
        with user_files.replace_atomically(path) as temporary:
            temporary.write_text(f"# {library.names[k]}: nm, f_lambda\n" + "\n".join(lines) + "\n", encoding="utf-8")
        written.append(path)
    return written


def magnorm(stars: pa.Table, library: Library) -> Float:
    """float64[n] mag of rows of the table `stars`."""
    rows = stars_from_table(stars, library)
    wavelength, flux = _rebin(library)
    level = flux[:, int(np.searchsorted(wavelength, _LEVEL_WAVELENGTH))]
    f_nu = star_scale(rows, library) * (rows.frac * level[rows.sed]).sum(0) * _LEVEL_WAVELENGTH**2 / LIGHT_ANGSTROM_S
    return np.asarray(-2.5 * np.log10(f_nu) - units.AB_CGS)


def _rebin(library: Library) -> tuple[Float, Float]:
    """(A; f_lambda[template]) every 10 A, the mean of the samples about each."""
    half = _SAMPLES_PER_BIN // 2
    start = int((_LEVEL_WAVELENGTH - library.wavelength[0] - half) % _SAMPLES_PER_BIN)
    count = (library.flux.shape[1] - start - 1) // _SAMPLES_PER_BIN
    # The two samples at the ends of a stretch belong half to its neighbours.
    weights = np.full(_SAMPLES_PER_BIN + 1, 1.0 / _SAMPLES_PER_BIN)
    weights[[0, -1]] *= 0.5
    flux = np.zeros((len(library), count))
    for k, weight in enumerate(weights):
        flux += weight * library.flux[:, start + k : start + k + _SAMPLES_PER_BIN * count : _SAMPLES_PER_BIN]
    # A template that is dark where its level is taken has one all the same.
    flux = np.maximum(flux, _MIN_RELATIVE_FLUX * flux.max(axis=1, keepdims=True))
    return library.wavelength[start + half :: _SAMPLES_PER_BIN][:count], flux
