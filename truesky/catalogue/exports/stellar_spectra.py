"""Write template spectra of stars for skyCatalogs, and compute the magnitude that scales a template to each star.

There is one text file seds/star_K.txt per template K. skyCatalogs searches for it in the folder that the environment
variable SIMS_SED_LIBRARY_DIR names. Each line contains a wavelength in nm (in steps of 1 nm) and f_lambda.
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

# Number of samples of a template (steps of 1 A) per sample of the written file (steps of 10 A).
_SAMPLES_PER_BIN = 10
# Wavelength at which skyCatalogs normalises spectra, A.
_LEVEL_WAVELENGTH = 5000.0
# Lower limit of all written samples, relative to the highest sample of the template.
_MIN_RELATIVE_FLUX = 1e-12


def relative_path(sed: int) -> str:
    """Return the path of the file with the template number `sed`, relative to the folder of the spectra."""
    return f"seds/star_{sed:03d}.txt"


def write(folder: Path, library: Library, templates: Sequence[int]) -> list[Path]:
    """Write template spectra of stars, one text file per template; existing files are replaced atomically.

    Parameters
    ----------
    folder : Path
        Folder in which the folder seds/ with the files is created.
    library : Library
        Template spectra of stars.
    templates : sequence of int
        Indices of the templates to write.

    Returns
    -------
    list of Path
        Files written.
    """
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
    """Return the AB magnitude of stars at 500 nm, without extinction; `stars` are rows of table `stars`."""
    rows = stars_from_table(stars, library)
    wavelength, flux = _rebin(library)
    level = flux[:, int(np.searchsorted(wavelength, _LEVEL_WAVELENGTH))]
    f_nu = star_scale(rows, library) * (rows.frac * level[rows.sed]).sum(0) * _LEVEL_WAVELENGTH**2 / LIGHT_ANGSTROM_S
    return np.asarray(-2.5 * np.log10(f_nu) - units.AB_CGS)


def _rebin(library: Library) -> tuple[Float, Float]:
    """Return wavelengths in steps of 10 A, and f_lambda of each template averaged around them, shape (templates, n)."""
    half = _SAMPLES_PER_BIN // 2
    start = int((_LEVEL_WAVELENGTH - library.wavelength[0] - half) % _SAMPLES_PER_BIN)
    count = (library.flux.shape[1] - start - 1) // _SAMPLES_PER_BIN
    # A bin has 11 samples. The samples at both ends count half, because they also belong to the neighbouring bins.
    weights = np.full(_SAMPLES_PER_BIN + 1, 1.0 / _SAMPLES_PER_BIN)
    weights[[0, -1]] *= 0.5
    flux = np.zeros((len(library), count))
    for k, weight in enumerate(weights):
        flux += weight * library.flux[:, start + k : start + k + _SAMPLES_PER_BIN * count : _SAMPLES_PER_BIN]
    # `magnorm` takes the logarithm of the flux at 500 nm, so it must be positive also for templates without flux there.
    flux = np.maximum(flux, _MIN_RELATIVE_FLUX * flux.max(axis=1, keepdims=True))
    return library.wavelength[start + half :: _SAMPLES_PER_BIN][:count], flux
