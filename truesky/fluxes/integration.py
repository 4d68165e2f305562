"""Compute band fluxes of many sources by direct integration over the wavelengths of the bands.

The sums equal those of `band_fluxes.band_fluxes`, which needs whole spectra (600 to 24000 A). Here only wavelengths
inside the bands are computed, for blocks of sources that stay in the processor's cache.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lake_schema import units
from lake_schema.arrays import Float, Float32, Int
from lake_schema.errors import BadInput
from truesky.fluxes import passbands
from truesky.fluxes.calibration import continuum_scale, star_scale
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.passbands import Passband
from truesky.fluxes.sources import Galaxies, Stars
from truesky.fluxes.spectra import extinction, lines
from truesky.fluxes.spectra.continuum import REFERENCE_BAND, amplitudes, dust_curves, observed_shape
from truesky.numerics import matrices

# Largest number of samples (sources times wavelengths) per block. The memory allocator keeps temporary arrays of this
# size (half a MB) for reuse.
_BLOCK = 60_000
# Largest gap (A) between two bands that are integrated in one wavelength window.
_GAP = 300
# Number of galaxies whose emission lines are computed in one block.
_LINE_ROWS = 128


@dataclass(frozen=True, slots=True)
class WavelengthWindow:
    """A range of wavelengths to which at least one band responds.

    Attributes
    ----------
    first : int
        Wavelength of the first sample in A. The w samples are 1 A apart.
    weights : float array, shape (w, n_band)
        Weights of every band such that f_nu = f_lambda @ weights; 0 outside the band.
    milky_way : float32 array, shape (w,)
        A(lambda) / A(V) of the Milky Way.
    reference : (int, int), optional
        First sample of the reference band, in which the catalogue gives magnitudes, and the sample after its last. None
        if this band is in another window or not needed.
    """

    first: int
    weights: Float
    milky_way: Float32
    reference: tuple[int, int] | None

    def __len__(self) -> int:
        return len(self.milky_way)


def galaxy_fluxes(rows: Galaxies, bands: Sequence[Passband], library: Library) -> Float:
    """Return the fluxes of galaxies with internal dust, lines, magnification and Milky Way extinction.

    Parameters
    ----------
    rows : Galaxies
        The galaxies.
    bands : sequence of Passband
        The passbands, at least one.
    library : Library
        Templates of galaxies.

    Returns
    -------
    float array, shape (n, n_band)
        f_nu in microjansky.

    Raises
    ------
    BadInput
        If there is no passband, or if dust leaves a galaxy no light in the band of its magnitude mag_r01.

    Notes
    -----
    The relative difference from integration over whole spectra is 1e-7 (tests/truesky/fluxes/test_integration.py).
    """
    reference, dust = passbands.load(REFERENCE_BAND), dust_curves(library)
    windows, reference_weights = _windows(bands, reference), passbands.weights(reference)
    # Sort by redshift, because all galaxies of a block get as many template samples as the galaxy that needs the most.
    order = np.argsort(rows.mix.z_obs, kind="stable")
    continuum, observed = np.zeros((len(rows), len(bands))), np.zeros(len(rows))
    for indices in _blocks(order, len(reference.wavelength)):
        block = rows.select(indices)
        amplitude = amplitudes(block.mix, reference, library, dust)
        # Divide the amplitudes of both templates by their sum, because single precision could underflow for smaller
        # numbers. The factor `scale` below restores the true flux.
        amplitude /= amplitude.sum(0)
        for window in windows:
            for block_rows in _blocks(np.arange(len(indices)), len(window)):
                mix, a_v = block.mix.select(block_rows), block.a_v[block_rows]
                shape = observed_shape(mix, amplitude[:, block_rows], library, dust, window.first, len(window))
                if window.reference is not None:
                    low, high = window.reference
                    observed[indices[block_rows]] = matrices.matmul(shape[:, low:high], reference_weights)
                shape *= extinction.transmission(window.milky_way, a_v.astype(np.float32)[:, None])
                continuum[indices[block_rows]] += matrices.matmul(shape, window.weights)
    scale = continuum_scale(rows.mag_r01, observed)
    f_nu = units.ujy_of_cgs(continuum * scale[:, None]) + _line_fluxes(rows, order, bands)
    return np.asarray(f_nu * rows.magnification[:, None])


def star_fluxes(rows: Stars, bands: Sequence[Passband], library: Library) -> Float:
    """Return the fluxes of stars, dimmed by the Milky Way dust in front of each star.

    Parameters
    ----------
    rows : Stars
        The stars.
    bands : sequence of Passband
        The passbands, at least one.
    library : Library
        Templates of stars.

    Returns
    -------
    float array, shape (n, n_band)
        f_nu in microjansky.

    Raises
    ------
    BadInput
        If there is no passband.
    """
    scale = star_scale(rows, library)
    f_nu = np.zeros((len(rows), len(bands)))
    for window in _windows(bands, None):
        low = window.first - int(library.wavelength[0])
        spectra = np.ascontiguousarray(library.flux[:, low : low + len(window)])
        for indices in _blocks(np.arange(len(rows)), len(window)):
            dimmed = extinction.transmission(window.milky_way, rows.a_v[indices].astype(np.float32)[:, None])
            mixed = np.zeros_like(dimmed)
            for sed, share in zip(rows.sed, rows.frac, strict=True):
                mixed += spectra[sed[indices]] * share[indices].astype(np.float32)[:, None]
            f_nu[indices] += matrices.matmul(dimmed * mixed, window.weights)
    return units.ujy_of_cgs(f_nu * scale[:, None])


def _blocks(rows: Int, width: int) -> Iterator[Int]:
    step = max(_BLOCK // width, 1)
    return (rows[start : start + step] for start in range(0, len(rows), step))


def _line_fluxes(rows: Galaxies, order: Int, bands: Sequence[Passband]) -> Float:
    """Return f_nu (microjansky) of each galaxy's emission lines in each band, float64[n, n_band].

    Milky Way extinction is included, lensing magnification is not. Blocks of galaxies are processed in the given
    order (indices sorted by redshift).
    """
    out = np.zeros((len(rows), len(bands)))
    sigma = lines.velocity_dispersion(rows.abs_mag_r01, rows.mix.z_obs)
    for medium in sorted({band.medium for band in bands}):
        in_medium = np.array([k for k, band in enumerate(bands) if band.medium == medium])
        limits = min(bands[k].wavelength[0] for k in in_medium), max(bands[k].wavelength[-1] for k in in_medium)
        table = _full_weights([bands[k] for k in in_medium])
        for start in range(0, len(order), _LINE_ROWS):
            indices = order[start : start + _LINE_ROWS]
            block = rows.select(indices)
            profiles = lines.profiles(block.lines, block.mix.z_obs, sigma[indices], medium, *limits)
            out[np.ix_(indices, in_medium)] = _line_block_fluxes(profiles, block, table)
    return units.ujy_of_cgs(out)


def _line_block_fluxes(profiles: lines.Profiles, rows: Galaxies, table: Float) -> Float:
    index = profiles.first[:, None] - passbands.GRID_FIRST + np.arange(profiles.f_lambda.shape[1])
    np.clip(index, 0, len(table) - 1, out=index)
    dust = extinction.transmission(table[:, -1][index], rows.a_v[profiles.row][:, None])
    line_fluxes = np.einsum("ij,ijk->ik", profiles.f_lambda * dust, table[:, :-1][index])
    return np.stack(
        [np.bincount(profiles.row, line_fluxes[:, k], minlength=len(rows)) for k in range(line_fluxes.shape[1])], 1
    )


def _full_weights(bands: Sequence[Passband]) -> Float:
    """Return the weights of each band and, in the last column, A(lambda) / A(V): float64[23401, n_band + 1].

    Rows are the wavelengths of passbands.grid(). Weights of the first and last row are 0, because wavelengths outside
    the grid are clipped to these rows.
    """
    grid = passbands.grid()
    table = np.zeros((len(grid), len(bands) + 1))
    for k, band in enumerate(bands):
        table[band.first : band.first + len(band.wavelength), k] = passbands.weights(band)
    table[[0, -1]] = 0.0
    table[:, -1] = extinction.milky_way_table(passbands.GRID_FIRST, len(grid))
    return table


def _windows(bands: Sequence[Passband], reference: Passband | None) -> list[WavelengthWindow]:
    """Return wavelength windows that together contain all bands and, if given, the reference band.

    Bands at most `_GAP` apart share a window. Raises BadInput if `bands` is empty.
    """
    all_bands = [*bands, *([reference] if reference is not None else [])]
    if not bands:
        raise BadInput("passbands: at least one is required")
    ends = sorted((int(band.wavelength[0]), int(band.wavelength[-1])) for band in all_bands)
    merged = [ends[0]]
    for first, last in ends[1:]:
        if first - merged[-1][1] <= _GAP:
            merged[-1] = (merged[-1][0], max(merged[-1][1], last))
        else:
            merged.append((first, last))
    return [_window(first, last, bands, reference) for first, last in merged]


def _window(first: int, last: int, bands: Sequence[Passband], reference: Passband | None) -> WavelengthWindow:
    weights = np.zeros((last - first + 1, len(bands)))
    for k, band in enumerate(bands):
        if (samples := _band_samples(band, first, last)) is not None:
            weights[slice(*samples), k] = passbands.weights(band)
    milky_way = extinction.milky_way_table(first, last + 1 - first).astype(np.float32)
    return WavelengthWindow(
        first, weights, milky_way, _band_samples(reference, first, last) if reference is not None else None
    )


def _band_samples(band: Passband, first: int, last: int) -> tuple[int, int] | None:
    """Return the first sample of a band in the window `first` to `last` (A), and the sample after its last.

    Return None if the band is in another window. A band never extends over two windows.
    """
    low = int(band.wavelength[0]) - first
    return (low, low + len(band.wavelength)) if 0 <= low <= last - first else None
