"""Magnitudes of galaxies from M_r = M(0.1r) - 5 log10 h, by a table of what redshift does to each template.

correction            m - M_r - DM of any band on (z, template, law, E(B-V)); in 0.1r it is the K-correction
apparent_magnitude    m = M_r + DM + correction
reference_magnitude   the same in 0.1r: the column mag_r01
ColorTable, rest_color_table   rest-frame 0.1(g - r), to be inverted for the template
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from jobs import cache
from jobs.fluxes import cosmology, extinction, passbands
from jobs.fluxes.continuum import EBV_MAX, REFERENCE_BAND, Mix, dust_of, rest_flux, within
from jobs.fluxes.passbands import Passband
from jobs.fluxes.templates import Library
from lake_schema.errors import BadInput

Float = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]

# Uniform in ln(1 + z), interpolated by cubics; polynomial in E(B-V) through Chebyshev nodes.
_Z_FIRST, _Z_LAST, _STEP = -0.02, 6.0, 0.005
_EBV_NODES = 9

# E(B-V) of the colour table: dense where the embedded universe draws.
COLOR_EBV = np.linspace(0.0, 0.6, 25)


@dataclass(frozen=True, slots=True)
class Correction:
    """m - M_r - DM of a band for one template, as ln of the flux ratio.

    log_ratio : float64[n_z, n_template, 5, n_ebv] ln(f_nu in the band seen at z / f_nu in 0.1r at rest), both
                after internal dust
    """

    band: str
    log_ratio: Float


@dataclass(frozen=True, slots=True)
class ColorTable:
    """ebv : float64[n_ebv];  color : float64[n_template, 5, n_ebv] rest-frame 0.1(g - r) after dust, AB."""

    ebv: Float
    color: Float


def correction(library: Library, band: Passband) -> Correction:
    """The table of a band for a library of galaxies, from the cache or made in a second.

    Error: 1e-4 mag in 0.1r and 3e-4 mag in I_E for z <= 2.3 and E(B-V) <= 3; 0.03 mag towards z = 6, where
    the Lyman edge is in the band
    """
    reference = passbands.load(REFERENCE_BAND)
    key = cache.content_key(
        Path(__file__).read_bytes(),
        extinction.laws(library.wavelength),
        library.wavelength,
        np.asarray(library.flux),
        *(array for each in (band, reference) for array in (each.wavelength, each.response)),
    )
    arrays = cache.cached_arrays(
        f"correction_{band.name}", key, lambda: {"log_ratio": _tabulate(library, band, reference)}
    )
    return Correction(band.name, arrays["log_ratio"])


def apparent_magnitude(abs_mag_r01: npt.ArrayLike, z_true: npt.ArrayLike, mix: Mix, table: Correction) -> Float:
    """Apparent AB magnitude, before lines, magnification and the Milky Way: M_r + DM(z_true) + K.

    abs_mag_r01 : [n] M(0.1r) - 5 log10 h, after internal dust
    z_true      : [n] > 0, gives the distance; mix.z_obs shifts the spectrum
    The distance has H0 = 100, as the absolute magnitude: any h cancels.
    Ref: Serrano et al. 2024, appendix B, eq. K_Corr and m_r
    """
    u = np.log1p(mix.z_obs)
    within("z_obs", mix.z_obs, _Z_FIRST, _Z_LAST)
    row, z_weights = _cubic(u)
    ratio = np.zeros(len(mix))
    for k in range(2):
        ebv_weights = _chebyshev_weights(mix.ebv[k])
        log_ratio = np.zeros(len(mix))
        for step in range(4):
            nodes = table.log_ratio[row + step, mix.sed[k], mix.law[k]]
            log_ratio += z_weights[step] * np.einsum("ij,ij->i", nodes, ebv_weights)
        ratio += mix.frac[k] * np.exp(log_ratio)
    dimming = -2.5 * np.log10(ratio / mix.frac.sum(0))
    return np.asarray(np.asarray(abs_mag_r01, float) + cosmology.distance_modulus(z_true) + dimming)


def reference_magnitude(abs_mag_r01: npt.ArrayLike, z_true: npt.ArrayLike, mix: Mix, table: Correction) -> Float:
    """The column mag_r01: `apparent_magnitude` in 0.1r, with K = 2.5 log10(f_rest / f_observed)."""
    if table.band != REFERENCE_BAND:
        raise BadInput(f"the reference magnitude wants the correction of {REFERENCE_BAND}, not of {table.band}")
    return apparent_magnitude(abs_mag_r01, z_true, mix, table)


def rest_color_table(library: Library) -> ColorTable:
    """Rest-frame 0.1(g - r) of every template behind every law, on E(B-V) = 0 .. 0.6 in steps of 0.025."""
    shape = (len(library), extinction.LAW_COUNT, len(COLOR_EBV))
    sed, law, node = (axis.ravel() for axis in np.indices(shape))
    dust = dust_of(library)
    g, r = (
        rest_flux(sed, law, COLOR_EBV[node], passbands.load(name), library, dust).reshape(shape)
        for name in ("sdss_g01", REFERENCE_BAND)
    )
    return ColorTable(COLOR_EBV, -2.5 * np.log10(g / r))


def _tabulate(library: Library, band: Passband, reference: Passband) -> Float:
    """By the transposed problem: at each node the weights of the band are shifted, once for all spectra."""
    dust, ebv = dust_of(library), _chebyshev_nodes()
    shape = (len(library), extinction.LAW_COUNT, len(ebv))
    sed, law, node = (axis.ravel() for axis in np.indices(shape))
    at_rest = rest_flux(sed, law, ebv[node], reference, library, dust)
    nodes = _z_nodes()
    first = int(band.wavelength[0] / (1.0 + nodes[-1]) - library.wavelength[0])
    last = int(band.wavelength[-1] / (1.0 + nodes[0]) - library.wavelength[0]) + 2
    k = dust[:, first:last]
    spectra = library.flux[sed, first:last]
    spectra *= extinction.transmitted(k[law], ebv[node].astype(np.float32)[:, None])
    weights = passbands.weights(band)
    total = float(weights.sum())
    rows = []
    for z in nodes:
        low, moved = _moved(band.wavelength / (1.0 + z) - library.wavelength[first], weights / total / (1.0 + z))
        rows.append(spectra[:, low : low + len(moved)] @ moved.astype(np.float32))
    observed = np.stack(rows).astype(float) * total
    # A template without flux that far in the ultraviolet: as faint as single precision goes.
    observed = np.maximum(observed, np.finfo(np.float32).tiny * total)
    return np.asarray(np.log(observed / at_rest).reshape(-1, *shape))


def _moved(position: Float, weights: Float) -> tuple[int, Float]:
    """Weights of linear interpolation at fractional positions, summed on the whole ones: (first, weights)."""
    index = np.floor(position).astype(np.int64)
    part = position - index
    low = int(index[0])
    out = np.bincount(index - low, weights * (1.0 - part), minlength=int(index[-1]) - low + 2)
    return low, np.asarray(out + np.bincount(index - low + 1, weights * part, minlength=len(out)), float)


def _z_nodes() -> Float:
    """Redshifts of the table."""
    count = int(np.ceil((np.log1p(_Z_LAST) - np.log1p(_Z_FIRST)) / _STEP)) + 1
    return np.asarray(np.expm1(np.log1p(_Z_FIRST) + _STEP * np.arange(count)))


def _cubic(u: Float) -> tuple[Int, tuple[Float, Float, Float, Float]]:
    """First of four nodes in ln(1 + z), and Lagrange's weights of the four (one-sided at the ends)."""
    position = (u - np.log1p(_Z_FIRST)) / _STEP
    row = np.clip(np.floor(position).astype(np.int64) - 1, 0, len(_z_nodes()) - 4)
    t = position - row - 1.0
    return row, (
        -t * (t - 1.0) * (t - 2.0) / 6.0,
        (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0,
        -(t + 1.0) * t * (t - 2.0) / 2.0,
        (t + 1.0) * t * (t - 1.0) / 6.0,
    )


def _chebyshev_nodes() -> Float:
    """E(B-V) nodes, crowded towards 0 (the map is quadratic): most galaxies have little dust."""
    x = np.cos(np.pi * (np.arange(_EBV_NODES) + 0.5) / _EBV_NODES)
    return np.asarray(EBV_MAX * (0.5 * (1.0 + x)) ** 2)


def _chebyshev_weights(ebv: Float) -> Float:
    """Lagrange's weights at the nodes, float64[n, n_ebv]."""
    to_x = 2.0 * np.sqrt(np.array(ebv, float) / EBV_MAX) - 1.0
    at_nodes = np.polynomial.chebyshev.chebvander(2.0 * np.sqrt(_chebyshev_nodes() / EBV_MAX) - 1.0, _EBV_NODES - 1)
    return np.polynomial.chebyshev.chebvander(to_x, _EBV_NODES - 1) @ np.linalg.inv(at_nodes)
