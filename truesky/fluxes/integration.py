"""Compute band fluxes of many sources by direct integration over the wavelengths of the bands.

The sums are the same as band_fluxes.band_fluxes of whole spectra, but in blocks that stay in the processor's cache.
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

# Samples (rows times wavelengths) per block. Temporary arrays of half a MB are kept by the allocator for reuse.
_BLOCK = 60_000
# Bands closer than this are integrated in one window, A.
_GAP = 300
# Galaxies whose lines are computed together.
_LINE_ROWS = 128


@dataclass(frozen=True, slots=True)
class WavelengthWindow:
    """A range of wavelengths to which at least one band responds.

    Attributes
    ----------
    first : int
        Wavelength of the first sample in A.
    weights : float array, shape (w, n_band)
        Weights of every band, 0 outside the band.
    milky_way : float32 array, shape (w,)
        A(lambda) / A(V) of the Milky Way.
    reference : (int, int), optional
        First sample of the reference band and the sample after its last; None if it is in another window.
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
        The passbands.
    library : Library
        Templates of galaxies.

    Returns
    -------
    float array, shape (n, n_band)
        f_nu in microjansky.

    Notes
    -----
    The error relative to integration over whole spectra is 1e-7 (tests/truesky/fluxes/test_integration.py).
    """
    reference, dust = passbands.load(REFERENCE_BAND), dust_curves(library)
    windows, reference_weights = _windows(bands, reference), passbands.weights(reference)
    # Galaxies with similar redshifts have windows of the same width.
    order = np.argsort(rows.mix.z_obs, kind="stable")
    continuum, observed = np.zeros((len(rows), len(bands))), np.zeros(len(rows))
    for indices in _blocks(order, len(reference.wavelength)):
        block = rows.select(indices)
        amplitude = amplitudes(block.mix, reference, library, dust)
        # Scale to order 1 for any units, so that single precision does not underflow.
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
    """Return the fluxes of stars behind the dust in front of each.

    Parameters
    ----------
    rows : Stars
        The stars.
    bands : sequence of Passband
        The passbands.
    library : Library
        Templates of stars.

    Returns
    -------
    float array, shape (n, n_band)
        f_nu in microjansky.
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
    """Return f_nu of the lines in microjansky, behind the Milky Way but not magnified: float64[n, n_band]."""
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
    """Return each band's weights on the grid, 0 at its ends, and A(lambda) / A(V) last: float64[23401, n_band + 1]."""
    grid = passbands.grid()
    table = np.zeros((len(grid), len(bands) + 1))
    for k, band in enumerate(bands):
        table[band.first : band.first + len(band.wavelength), k] = passbands.weights(band)
    table[[0, -1]] = 0.0
    table[:, -1] = extinction.milky_way(grid)
    return table


def _windows(bands: Sequence[Passband], reference: Passband | None) -> list[WavelengthWindow]:
    """Return the windows that contain all bands and the reference band."""
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
    milky_way = extinction.milky_way(np.arange(first, last + 1.0)).astype(np.float32)
    return WavelengthWindow(
        first, weights, milky_way, _band_samples(reference, first, last) if reference is not None else None
    )


def _band_samples(band: Passband, first: int, last: int) -> tuple[int, int] | None:
    """Return the samples of a band in a window. A band is inside a single window."""
    low = int(band.wavelength[0]) - first
    return (low, low + len(band.wavelength)) if 0 <= low <= last - first else None
