"""The continuum of galaxies: two templates, each behind its own dust, mixed and redshifted.

Mix, mix_of         what shapes the continuum of n galaxies
rest_flux           f_nu of one component in the rest frame, after its dust
amplitudes          what each component is multiplied by
observed_shape      combined, extinguished, redshifted f_lambda on any stretch of whole angstroms

Ref: Serrano et al. 2024, appendix B. There two templates share one law and one E(B-V); here each component
has its own, and is normalised in the 0.1r band behind it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float, Float32, Int
from lake_schema.errors import BadInput, OutOfRange
from truesky.fluxes import passbands
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.passbands import Passband
from truesky.fluxes.spectra import extinction, intergalactic
from truesky.numerics import matrices

REFERENCE_BAND = "sdss_r01"
COMPONENTS = (1, 2)
EBV_MAX = 3.0


@dataclass(frozen=True, slots=True)
class TemplateMix:
    """Two components of n galaxies.

    z_obs     : float64[n]
    sed, law  : int64[2, n] template index, extinction law code
    frac, ebv : float64[2, n] share of the rest-frame 0.1r flux after dust, E(B-V)
    """

    z_obs: Float
    sed: Int
    law: Int
    frac: Float
    ebv: Float

    def __len__(self) -> int:
        return len(self.z_obs)

    def select(self, indices: Int | slice) -> TemplateMix:
        return TemplateMix(
            take_last_axis(self.z_obs, indices),
            take_last_axis(self.sed, indices),
            take_last_axis(self.law, indices),
            take_last_axis(self.frac, indices),
            take_last_axis(self.ebv, indices),
        )


_Array = TypeVar("_Array", Float, Int)


def take_last_axis(values: _Array, indices: Int | slice) -> _Array:
    """values[..., chosen]; by `take`, which is twice as fast as indexing."""
    return values[..., indices] if isinstance(indices, slice) else np.take(values, indices, -1)


def dust_curves(library: Library) -> Float32:
    """k(lambda) of the five laws on the grid of a library, float32[5, n_lambda]."""
    return extinction.laws(library.wavelength).astype(np.float32) if library.dust is None else library.dust


def mix_from_columns(columns: Mapping[str, npt.ArrayLike], library: Library) -> TemplateMix:
    """Checked Mix from the columns z_obs, sed_k, frac_k, ext_law_k, ebv_k (k = 1, 2) of the table `galaxies`.

    Errors: BadInput for a missing column or NaN; OutOfRange names the column
    """
    required = ["z_obs", *(f"{name}_{k}" for name in ("sed", "frac", "ext_law", "ebv") for k in COMPONENTS)]
    if absent := [name for name in required if name not in columns]:
        raise BadInput(f"galaxies: column {', '.join(absent)} is missing")
    grid = library.wavelength
    z_lo, z_hi = passbands.GRID_LAST / float(grid[-1]) - 1.0, passbands.GRID_FIRST / float(grid[0]) - 1.0
    limits = {
        "sed": (0, len(library) - 1),
        "ext_law": (0, extinction.LAW_COUNT - 1),
        "frac": (0.0, 1.0),
        "ebv": (0.0, EBV_MAX),
    }
    values = {name: np.asarray(columns[name], float) for name in required}
    for name in required:
        check_range(name, values[name], *limits.get(name[:-2], (z_lo, z_hi)))
    sed, frac, law, ebv = (
        np.stack([values[f"{name}_{k}"] for k in COMPONENTS]) for name in ("sed", "frac", "ext_law", "ebv")
    )
    if (frac.sum(0) <= 0.0).any():
        raise BadInput("galaxies: frac_1 and frac_2 are both 0")
    return TemplateMix(values["z_obs"], sed.astype(np.int64), law.astype(np.int64), frac, ebv)


def check_range(name: str, values: Float, lo: float, hi: float) -> None:
    """OutOfRange for the first value outside [lo, hi]; NaN is outside.

    name : in the refusal;  values : float64[...]
    """
    bad = ~((values >= lo) & (values <= hi))
    if bad.any():
        raise OutOfRange(name, float(values[bad].ravel()[0]), lo, hi)


def rest_flux(sed: Int, law: Int, ebv: Float, band: Passband, library: Library, dust: Float32) -> Float:
    """Band-averaged f_nu of templates behind dust, at z = 0: float64[n], in units of the library.

    sed, law : int64[n] template and extinction law;  ebv : float64[n] E(B-V), mag
    band     : passband;  library : templates;  dust : float32[law, n_lambda] curve of each law
    """
    first = int(band.wavelength[0] - library.wavelength[0])
    stretch = slice(first, first + len(band.wavelength))
    ebv32 = ebv.astype(np.float32)[:, None]
    spectra = library.flux[:, stretch][sed] * extinction.transmission(dust[:, stretch][law], ebv32)
    # Summed in double precision: the rounding then averages out, and no sum depends on its neighbours.
    return np.asarray(matrices.matmul(spectra, passbands.weights(band)))


def amplitudes(mix: TemplateMix, band: Passband, library: Library, dust: Float32) -> Float:
    """float64[2, n]: frac / rest-frame f_nu of each component in the reference band.

    mix  : components of n galaxies;  band : passband
    library, dust : as of `rest_flux`
    """
    return np.stack(
        [
            mix.frac[k] / rest_flux(mix.sed[k], mix.law[k], mix.ebv[k], band, library, dust)
            for k in range(len(COMPONENTS))
        ]
    )


def observed_shape(
    mix: TemplateMix, amplitude: Float, library: Library, dust: Float32, first: int, count: int
) -> Float32:
    """f_lambda in the observed frame at `count` whole angstroms from `first`: float32[n, count].

    amplitude : float64[2, n] factor of each component
    Combined and extinguished on the library's grid; then wavelengths times (1 + z), flux divided by (1 + z),
    and linear interpolation onto the observed grid, behind what is between the galaxies where the library says so.
    mix       : components of n galaxies;  library, dust : as of `rest_flux`
    """
    shrink = 1.0 / (1.0 + mix.z_obs)
    start = first * shrink - library.wavelength[0]
    first_index = np.floor(start).astype(np.int64)
    # One sample more than the last one needs, to interpolate to.
    width = int(np.max(np.floor(start + (count - 1) * shrink).astype(np.int64) - first_index)) + 2
    rest = _rest_shape(mix, (amplitude * shrink).astype(np.float32), library, dust, first_index, width)
    # Positions in double precision: 24000 A times the single-precision step would be off by 1e-3 A.
    position = shrink[:, None] * np.arange(float(count))
    position += (start - first_index + width * np.arange(len(mix)))[:, None]
    floor = np.floor(position)
    index = floor.astype(np.int64)
    position -= floor
    steps = np.empty_like(rest)
    np.subtract(rest[:, 1:], rest[:, :-1], out=steps[:, :-1])
    # mode="clip" only because it is twice as fast as the checked one: the indices are inside by construction.
    shape = steps.ravel().take(index, mode="clip")
    shape *= position.astype(np.float32)
    shape += rest.ravel().take(index, mode="clip")
    if library.intergalactic:
        shape *= intergalactic.transmission(first + np.arange(float(count)), mix.z_obs).astype(np.float32)
    return shape


def _rest_shape(
    mix: TemplateMix, amplitude: Float32, library: Library, dust: Float32, start: Int, width: int
) -> Float32:
    """Combined and extinguished on `width` samples of the library's grid from `start`: float32[n, width]."""
    shared = bool((mix.law[0] == mix.law[1]).all() and (mix.ebv[0] == mix.ebv[1]).all())
    total = _windows(library.flux, mix.sed[0], start, width)
    total *= amplitude[0][:, None]
    if not shared:
        total *= _transmission(mix, 0, dust, start, width)
    second = _windows(library.flux, mix.sed[1], start, width)
    second *= amplitude[1][:, None]
    if not shared:
        second *= _transmission(mix, 1, dust, start, width)
    total += second
    if shared:
        total *= _transmission(mix, 0, dust, start, width)
    return total


def _transmission(mix: TemplateMix, component: int, dust: Float32, start: Int, width: int) -> Float32:
    k = _windows(dust, mix.law[component], start, width)
    out: Float32 = extinction.transmission(k, mix.ebv[component].astype(np.float32)[:, None])
    return out


def _windows(table: Float32, row: Int, start: Int, width: int) -> Float32:
    """table[row[i], start[i] : start[i] + width] for every i; copying slices is faster than indexing."""
    out = np.zeros((len(row), width), np.float32)
    for i, (r, s) in enumerate(zip(row.tolist(), start.tolist(), strict=True)):
        window = table[r, s : s + width]
        out[i, : len(window)] = window
    return out
