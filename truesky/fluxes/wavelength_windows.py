"""Spectra of many sources over one stretch of wavelengths: what is spread out by a grism.

galaxies   f_lambda of rows of `galaxies` whose templates are in the galaxy library
stars      f_lambda of rows of `stars`

The same as band_fluxes' whole spectra, where they are wanted, in blocks that stay in the processor's cache.
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

# Rows of a block: a MB of wavelengths.
_ROWS = 32


def galaxy_spectra(rows: Galaxies, first: int, count: int, library: Library) -> Float32:
    """f_lambda, float32[n, count] erg s-1 cm-2 A-1 at whole angstroms from `first`, vacuum.

    Internal dust, lines, magnification and the Milky Way included.
    rows : galaxies;  first, count : of the stretch, A;  library : templates of galaxies
    Error: 1e-6 relative to the whole spectra's (tests/truesky/fluxes/test_wavelength_windows.py)
    """
    reference, dust = passbands.load(REFERENCE_BAND), dust_curves(library)
    weights, grid = passbands.weights(reference), first + np.arange(float(count))
    sigma = lines.velocity_dispersion(rows.abs_mag_r01, rows.mix.z_obs)
    milky_way = extinction.milky_way(grid).astype(np.float32)
    out = np.empty((len(rows), count), np.float32)
    # Neighbours in redshift share the width of their windows.
    order = np.argsort(rows.mix.z_obs, kind="stable")
    for start in range(0, len(rows), _ROWS):
        indices = order[start : start + _ROWS]
        block = rows.select(indices)
        amplitude = amplitudes(block.mix, reference, library, dust)
        # Of order 1 whatever the units, so that single precision does not underflow.
        amplitude /= amplitude.sum(0)
        reference_shape = observed_shape(
            block.mix, amplitude, library, dust, int(reference.wavelength[0]), len(weights)
        )
        scale = continuum_scale(block.mag_r01, matrices.matmul(reference_shape, weights))
        shape = observed_shape(block.mix, amplitude, library, dust, first, count)
        spectra = shape * scale[:, None]
        profiles = lines.profiles(block.lines, block.mix.z_obs, sigma[indices], "vacuum", grid[0], grid[-1])
        lines.add(spectra, first, profiles)
        spectra *= block.magnification[:, None]
        spectra *= extinction.transmission(milky_way, block.a_v.astype(np.float32)[:, None])
        out[indices] = spectra
    return out


def star_spectra(rows: Stars, first: int, count: int, library: Library) -> Float32:
    """f_lambda, float32[n, count] erg s-1 cm-2 A-1 at whole angstroms from `first`, vacuum.

    rows : stars;  first, count : of the stretch, A;  library : templates of stars
    """
    low = first - int(library.wavelength[0])
    milky_way = extinction.milky_way(first + np.arange(float(count)))
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
