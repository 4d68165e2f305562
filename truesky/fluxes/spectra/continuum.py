"""Compute the continuum of galaxies: two template spectra, each with its own dust, mixed and redshifted.

A component is a template with an extinction law and E(B-V). Its fraction is that of the light after dust in the
reference band 0.1r (SDSS r, shifted to the blue by a factor 1.1).

References
----------
Serrano et al. 2024, appendix B, where both templates have the same extinction law and E(B-V).
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
from truesky.numerics.compiling import exact_jit

REFERENCE_BAND = "sdss_r01"
COMPONENTS = (1, 2)
EBV_MAX = 3.0


@dataclass(frozen=True, slots=True)
class TemplateMix:
    """Redshifts of n galaxies, and the two components (template spectra with dust) of each.

    Attributes
    ----------
    z_obs : float array, shape (n,)
        Observed redshift.
    sed : int array, shape (2, n)
        Index of each component's template in the galaxy library.
    law : int array, shape (2, n)
        Code of each component's extinction law, 0 (no dust) to 4; see `extinction`.
    frac : float array, shape (2, n)
        Fraction of each component in the galaxy's rest-frame 0.1r flux after dust.
    ebv : float array, shape (2, n)
        E(B-V) of each component in mag.
    """

    z_obs: Float
    sed: Int
    law: Int
    frac: Float
    ebv: Float

    def __len__(self) -> int:
        return len(self.z_obs)

    def select(self, indices: Int | slice) -> TemplateMix:
        """Return the galaxies with the given indices, or in the given slice."""
        return TemplateMix(
            take_last_axis(self.z_obs, indices),
            take_last_axis(self.sed, indices),
            take_last_axis(self.law, indices),
            take_last_axis(self.frac, indices),
            take_last_axis(self.ebv, indices),
        )


_Array = TypeVar("_Array", Float, Int)


def take_last_axis(values: _Array, indices: Int | slice) -> _Array:
    """Return values[..., indices] with `take`, which is twice as fast as indexing."""
    return values[..., indices] if isinstance(indices, slice) else np.take(values, indices, -1)


def dust_curves(library: Library) -> Float32:
    """Return k(lambda) = A(lambda) / E(B-V) of a library's five extinction laws, float32[5, n_lambda].

    They are at the wavelengths of the library. The built-in laws are used if `library.dust` is None.
    """
    return extinction.laws(library.wavelength).astype(np.float32) if library.dust is None else library.dust


def mix_from_columns(columns: Mapping[str, npt.ArrayLike], library: Library) -> TemplateMix:
    """Check columns of the table `galaxies`, and convert them to a TemplateMix.

    Parameters
    ----------
    columns : mapping of str to array, shape (n,)
        Columns z_obs, sed_k, frac_k, ext_law_k, ebv_k (k = 1, 2).
    library : Library
        Templates to which sed_1 and sed_2 refer. Its wavelengths limit the redshifts.

    Returns
    -------
    TemplateMix
        Redshifts and components of the galaxies.

    Raises
    ------
    BadInput
        If a column is missing, or frac_1 and frac_2 of a galaxy are both 0.
    OutOfRange
        If a value is out of range or NaN. The message names the column.
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
    """Check that all values are in a range.

    Parameters
    ----------
    name : str
        Name of the column, for the error message.
    values : float array
        Values of any shape; an empty array is accepted.
    lo, hi : float
        Limits; values equal to a limit are accepted.

    Raises
    ------
    OutOfRange
        If a value is outside [lo, hi] or NaN. The message contains the first such value.
    """
    bad = ~((values >= lo) & (values <= hi))
    if bad.any():
        raise OutOfRange(name, float(values[bad].ravel()[0]), lo, hi)


def rest_flux(sed: Int, law: Int, ebv: Float, band: Passband, library: Library, dust: Float32) -> Float:
    """Return the band-averaged f_nu of templates behind dust at z = 0.

    Parameters
    ----------
    sed : int array, shape (n,)
        Indices of the templates.
    law : int array, shape (n,)
        Code of the extinction law of each template.
    ebv : float array, shape (n,)
        E(B-V) of each template in mag.
    band : Passband
        The passband. The library must cover it.
    library : Library
        Templates.
    dust : float32 array, shape (n_law, n_lambda)
        k(lambda) of each extinction law at the library's wavelengths.

    Returns
    -------
    float array, shape (n,)
        f_nu in erg s-1 cm-2 Hz-1 for templates with f_lambda near 1 erg s-1 cm-2 A-1, as they are stored.
    """
    first = int(band.wavelength[0] - library.wavelength[0])
    stretch = slice(first, first + len(band.wavelength))
    ebv32 = ebv.astype(np.float32)[:, None]
    spectra = library.flux[:, stretch][sed] * extinction.transmission(dust[:, stretch][law], ebv32)
    # `matmul` sums in double precision, so that rounding errors average out. The sum of a row does not depend on the
    # other rows.
    return np.asarray(matrices.matmul(spectra, passbands.weights(band)))


def amplitudes(mix: TemplateMix, band: Passband, library: Library, dust: Float32) -> Float:
    """Return the factors of the two templates of each galaxy, with which their fractions in the reference band are met.

    A factor is the template's fraction divided by its rest-frame f_nu in this band after dust.

    Parameters
    ----------
    mix : TemplateMix
        Components of n galaxies.
    band : Passband
        Reference band.
    library : Library
        Templates.
    dust : float32 array, shape (n_law, n_lambda)
        k(lambda) of each extinction law at the library's wavelengths.

    Returns
    -------
    float array, shape (2, n)
        Factors.
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
    """Return the combined, extinguished and redshifted continuum on whole angstroms of the observed frame.

    Parameters
    ----------
    mix : TemplateMix
        Components of n galaxies, at least one.
    amplitude : float array, shape (2, n)
        Factor of each template, from `amplitudes`.
    library : Library
        Templates.
    dust : float32 array, shape (n_law, n_lambda)
        k(lambda) of each extinction law at the library's wavelengths.
    first : int
        First observed wavelength in A.
    count : int
        Number of wavelengths in steps of 1 A.

    Returns
    -------
    float32 array, shape (n, count)
        f_lambda in the observed frame, before it is scaled to the galaxies' magnitudes. Milky Way dust is not included.

    Notes
    -----
    Both templates are multiplied by their dust and added at the library's wavelengths. Wavelengths are then multiplied
    by (1 + z), the flux is divided by (1 + z), and the result is interpolated linearly to the observed grid.
    Intergalactic absorption is applied if `library.intergalactic` is True.
    """
    shrink = 1.0 / (1.0 + mix.z_obs)
    start = first * shrink - library.wavelength[0]
    first_index = np.floor(start).astype(np.int64)
    # Number of rest-frame samples of each galaxy, with the sample after the last position, for interpolation.
    width = int(np.max(np.floor(start + (count - 1) * shrink).astype(np.int64) - first_index)) + 2
    rest = _rest_shape(mix, (amplitude * shrink).astype(np.float32), library, dust, first_index, width)
    shape = np.empty((len(mix), count), np.float32)
    _interpolate(rest, start - first_index, shrink, shape)
    if library.intergalactic:
        (absorbed,) = np.nonzero(first < intergalactic.first_transparent(mix.z_obs))
        if len(absorbed):
            grid = first + np.arange(float(count))
            shape[absorbed] *= intergalactic.transmission(grid, mix.z_obs[absorbed]).astype(np.float32)
    return shape


@exact_jit
def _interpolate(rest: Float32, start: Float, shrink: Float, out: Float32) -> None:
    """Interpolate n rows of samples linearly at the positions `start` + `shrink` j, and store them in `out` [n, w].

    Positions are indices of samples with fractions, in double precision: single precision would be wrong by 1e-3 A.
    Each must have a sample on both sides.
    """
    for i in range(len(out)):
        samples, line = rest[i], out[i]
        for j in range(len(line)):
            position = start[i] + shrink[i] * j
            index = int(position)
            line[j] = samples[index] + np.float32(position - index) * (samples[index + 1] - samples[index])


def _rest_shape(
    mix: TemplateMix, amplitude: Float32, library: Library, dust: Float32, start: Int, width: int
) -> Float32:
    """Return the sum of both templates after dust, float32[n, width], at rest-frame wavelengths.

    The wavelengths are `width` samples of the library from index `start` of each galaxy. Transmission is computed only
    once if both templates of all galaxies have the same dust.
    """
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
    """Return table[row[i], start[i] : start[i] + width] for every i, float32[n, width].

    Values beyond the end of the table are 0. `start` must not be negative.
    """
    out = np.empty((len(row), width), np.float32)
    _copy_windows(table, row, start, out)
    return out


@exact_jit
def _copy_windows(table: Float32, row: Int, start: Int, out: Float32) -> None:
    for i in range(len(row)):
        inside = max(min(table.shape[1] - start[i], out.shape[1]), 0)
        out[i, :inside] = table[row[i], start[i] : start[i] + inside]
        out[i, inside:] = np.float32(0.0)
