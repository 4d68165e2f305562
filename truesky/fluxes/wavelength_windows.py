"""Compute spectra of many sources in one range of wavelengths, for grism spectroscopy.

The spectra equal the results of `band_fluxes` in the requested range. They are computed in blocks of sources that stay
in the processor's cache.
"""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float32
from truesky.fluxes import passbands
from truesky.fluxes.calibration import continuum_scale, star_scale
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.sources import Galaxies, Stars
from truesky.fluxes.spectra import extinction, lines
from truesky.fluxes.spectra.continuum import REFERENCE_BAND, amplitudes, dust_curves, observed_shape
from truesky.numerics import matrices

# Number of sources per block. Their spectra are about 1 MB.
_ROWS = 32


def galaxy_spectra(rows: Galaxies, first: int, count: int, library: Library) -> Float32:
    """Return spectra of galaxies with internal dust, lines, magnification and Milky Way extinction.

    Parameters
    ----------
    rows : Galaxies
        The galaxies.
    first : int
        First observed wavelength in A (vacuum).
    count : int
        Number of wavelengths in steps of 1 A.
    library : Library
        Templates of galaxies.

    Returns
    -------
    float32 array, shape (n, count)
        f_lambda in erg s-1 cm-2 A-1.

    Notes
    -----
    The relative difference from `band_fluxes.galaxy_spectra` is 1e-6
    (tests/truesky/fluxes/test_wavelength_windows.py).
    """
    reference, dust = passbands.load(REFERENCE_BAND), dust_curves(library)
    weights, grid = passbands.weights(reference), first + np.arange(float(count))
    sigma = lines.velocity_dispersion(rows.abs_mag_r01, rows.mix.z_obs)
    milky_way = extinction.milky_way_table(first, count).astype(np.float32)
    out = np.empty((len(rows), count), np.float32)
    # Sort by redshift, because all galaxies of a block get as many template samples as the galaxy that needs the most.
    order = np.argsort(rows.mix.z_obs, kind="stable")
    for start in range(0, len(rows), _ROWS):
        indices = order[start : start + _ROWS]
        block = rows.select(indices)
        amplitude = amplitudes(block.mix, reference, library, dust)
        # Divide the amplitudes of both templates by their sum, because single precision could underflow for smaller
        # numbers. The factor `scale` below restores the true flux.
        amplitude /= amplitude.sum(0)
        reference_shape = observed_shape(
            block.mix, amplitude, library, dust, int(reference.wavelength[0]), len(weights)
        )
        scale = continuum_scale(block.mag_r01, matrices.matmul(reference_shape, weights))
        spectra = observed_shape(block.mix, amplitude, library, dust, first, count)
        # Single precision is enough for the factors, and keeps all steps in it.
        spectra *= scale.astype(np.float32)[:, None]
        profiles = lines.profiles(block.lines, block.mix.z_obs, sigma[indices], "vacuum", grid[0], grid[-1])
        lines.add(spectra, first, profiles)
        spectra *= block.magnification.astype(np.float32)[:, None]
        spectra *= extinction.transmission(milky_way, block.a_v.astype(np.float32)[:, None])
        out[indices] = spectra
    return out


def star_spectra(rows: Stars, first: int, count: int, library: Library) -> Float32:
    """Return spectra of stars, dimmed by the dust in front of each star.

    Parameters
    ----------
    rows : Stars
        The stars.
    first : int
        First wavelength in A (vacuum), 600 or more.
    count : int
        Number of wavelengths in steps of 1 A; the last must not be above 24000 A.
    library : Library
        Templates of stars.

    Returns
    -------
    float32 array, shape (n, count)
        f_lambda in erg s-1 cm-2 A-1.
    """
    low = first - int(library.wavelength[0])
    milky_way = extinction.milky_way_table(first, count)
    scale = star_scale(rows, library)
    out = np.empty((len(rows), count), np.float32)
    for start in range(0, len(rows), _ROWS):
        block = slice(start, start + _ROWS)
        dimmed = extinction.transmission(milky_way, rows.a_v[block][:, None])
        mixed = np.zeros(dimmed.shape)
        for sed, share in zip(rows.sed[:, block], rows.frac[:, block], strict=True):
            mixed += library.flux[sed, low : low + count] * share[:, None]
        out[block] = mixed * dimmed * scale[block, None]
    return out
