"""The tables of fluxes: made in seconds, kept in the cache, mapped from disc.

Setting        how fine a table of galaxies is: three numbers
galaxy_table   continuum of every template behind every law: redshift x E(B-V) x A_V
star_table     every star behind the dust on the way to it
line_table     what a band makes of a line: wavelength x width
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float, Float32
from lake_schema.units import LIGHT_KM_S
from truesky.fluxes import passbands
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.passbands import Passband
from truesky.fluxes.spectra import extinction, intergalactic, lines
from truesky.fluxes.spectra.continuum import REFERENCE_BAND, dust_curves, rest_flux
from truesky.numerics import cache, matrices
from truesky.numerics.code_fingerprints import code_key

# What the tables of galaxies cover: any redshift that a request may ask for, with its peculiar velocity.
Z_FIRST, Z_LAST = -0.021, 3.03
EBV_LAST, A_V_LAST = 0.6, 1.55
# Stars behind more than this are integrated.
STAR_A_V_LAST = 5.0
STAR_COEFFICIENTS = 12

# Widths of lines that are tabulated, km/s: linear in sigma^2 in between.
LINE_SIGMA = lines.SIGMA_MIN * 2.0 ** (np.arange(13) / 4.0)
LINE_STEP = 25.0 / LIGHT_KM_S
_LINE_REACH = 6.0


@dataclass(frozen=True, slots=True)
class Setting:
    """step in ln(1 + z); n_ebv, n_av: numbers of coefficients in E(B-V) and in A_V."""

    step: float
    n_ebv: int
    n_av: int

    @property
    def z_count(self) -> int:
        return int(np.ceil((np.log1p(Z_LAST) - np.log1p(Z_FIRST)) / self.step)) + 1

    @property
    def size(self) -> int:
        """Coefficients a template and law."""
        return self.z_count * self.n_ebv * self.n_av

    def log_z(self, node: int) -> float:
        """ln(1 + z) of a node."""
        return float(np.log1p(Z_FIRST)) + self.step * node


@lru_cache(maxsize=4)
def library_key(library: Library) -> str:
    """Key of a library's spectra and of the dust in front of them; a tenth of a second, once a library."""
    absorbed = [code_key(intergalactic.__name__)] if library.intergalactic else []
    return cache.content_key(library.wavelength, np.asarray(library.flux), dust_curves(library), *absorbed)


def galaxy_table(band: Passband, library: Library, setting: Setting, key: str) -> Float32:
    """ln(f_nu in the band at z / f_nu in the reference band at rest), both behind dust, of each template.

    key     : library_key(library)
    band    : passband;  library : templates;  setting : how fine the table is
    returns : float32[n_template, 4, n_z, n_ebv * n_av] Chebyshev coefficients; laws 1 .. 4, of which any is none at
              E(B-V) = 0
    """
    reference = passbands.load(REFERENCE_BAND)
    numbers = (setting.step, setting.n_ebv, setting.n_av)
    full_key = cache.content_key(code_key(__name__), key, *numbers, *_curve_arrays(band), *_curve_arrays(reference))
    arrays = cache.cached_arrays(
        f"galaxy_table_{band.name}",
        full_key,
        lambda: {"galaxies": _compute_galaxy_table(library, band, reference, setting)},
    )
    return arrays["galaxies"]


def star_table(band: Passband, library: Library, key: str) -> Float32:
    """ln(f_nu) of each star of a library in units of its spectrum: float32[n_template, 12] coefficients in A_V.

    Error: 1e-6 (tests/truesky/fluxes/tables/test_flux_tables.py)
    """
    full_key = cache.content_key(code_key(__name__), key, *_curve_arrays(band))
    arrays = cache.cached_arrays(
        f"star_table_{band.name}", full_key, lambda: {"stars": _compute_star_table(library, band)}
    )
    return arrays["stars"]


def line_table(band: Passband) -> tuple[float, Float32]:
    """ln(first wavelength / A) and float32[n_lambda, n_sigma]: f_nu (erg s-1 cm-2 Hz-1) for a line of unit flux.

    Uniform in ln(lambda) by LINE_STEP; the columns are LINE_SIGMA.
    """
    full_key = cache.content_key(code_key(__name__), LINE_SIGMA, *_curve_arrays(band))
    arrays = cache.cached_arrays(f"line_table_{band.name}", full_key, lambda: _compute_line_table(band))
    return float(arrays["first"][0]), arrays["lines"]


def chebyshev_nodes(count: int, last: float) -> Float:
    """Chebyshev's nodes in [0, last]; a single one is for what stands before the dust."""
    if count == 1:
        return np.zeros(1)
    return np.asarray(0.5 * last * (1.0 + np.cos(np.pi * (np.arange(count) + 0.5) / count)))


def chebyshev(values: Float, last: float, count: int) -> Float:
    """Polynomials T_0 .. T_(count - 1) on [0, last], float64[..., count]."""
    return np.asarray(np.polynomial.chebyshev.chebvander(2.0 * values / last - 1.0, count - 1))


def _curve_arrays(band: Passband) -> tuple[Float, Float]:
    return band.wavelength, band.response


def _compute_galaxy_table(library: Library, band: Passband, reference: Passband, setting: Setting) -> Float32:
    """By the transposed problem: at each redshift the weights of the band are moved, once for all spectra."""
    dust = dust_curves(library)
    ebv, a_v = chebyshev_nodes(setting.n_ebv, EBV_LAST), chebyshev_nodes(setting.n_av, A_V_LAST)
    shape = (len(library), extinction.LAW_COUNT - 1, setting.n_ebv)
    sed, law, node = (axis.ravel() for axis in np.indices(shape))
    law += 1
    at_rest = rest_flux(sed, law, ebv[node], reference, library, dust)
    nearest, farthest = setting.log_z(0), setting.log_z(setting.z_count - 1)
    first = int(band.wavelength[0] / np.exp(farthest) - library.wavelength[0])
    last = int(band.wavelength[-1] / np.exp(nearest) - library.wavelength[0]) + 2
    spectra = library.flux[sed, first:last]
    spectra *= extinction.transmission(dust[law, first:last], ebv[node].astype(np.float32)[:, None])
    # By wavelength, as the sums go.
    spectra = np.ascontiguousarray(spectra.T)
    weights = passbands.weights(band)
    total = float(weights.sum())
    dimmed = weights / total * extinction.transmission(extinction.milky_way(band.wavelength), a_v[:, None])
    observed = np.empty((setting.z_count, len(sed), setting.n_av))
    for i in range(setting.z_count):
        stretch = np.exp(setting.log_z(i))
        weights_at_z = dimmed / stretch
        if library.intergalactic:
            weights_at_z = weights_at_z * intergalactic.transmission(band.wavelength, stretch - 1.0)
        low, shifted = _shift_weights(band.wavelength / stretch - library.wavelength[first], weights_at_z)
        observed[i] = matrices.matmul(shifted, spectra[low : low + shifted.shape[1]]).T
    # A template without flux that far in the ultraviolet: as faint as single precision goes.
    np.maximum(observed, np.finfo(np.float32).tiny, out=observed)
    observed *= (total / at_rest)[:, None]
    log_ratio = np.log(observed).reshape(setting.z_count, *shape, setting.n_av)
    to_ebv, to_av = _to_coefficients(setting.n_ebv), _to_coefficients(setting.n_av)
    in_av = np.moveaxis(matrices.matmul(log_ratio, to_av.T), 3, 4)
    table = np.moveaxis(matrices.matmul(in_av, to_ebv.T), (0, 4), (2, 3))
    return np.ascontiguousarray(table.reshape(*shape[:2], setting.z_count, -1), np.float32)


def _compute_star_table(library: Library, band: Passband) -> Float32:
    a_v = chebyshev_nodes(STAR_COEFFICIENTS, STAR_A_V_LAST)
    inside = slice(band.first, band.first + len(band.wavelength))
    dimmed = passbands.weights(band) * extinction.transmission(extinction.milky_way(band.wavelength), a_v[:, None])
    f_nu = matrices.matmul(library.flux[:, inside], dimmed.T)
    # Cool stars have nothing left in the ultraviolet.
    f_nu = np.maximum(f_nu, np.finfo(float).tiny)
    return np.asarray(matrices.matmul(np.log(f_nu), _to_coefficients(STAR_COEFFICIENTS).T), np.float32)


def _compute_line_table(band: Passband) -> dict[str, npt.NDArray[np.generic]]:
    """The band's weights, constant over each bin of 1 A, convolved with Gaussians."""
    from scipy.special import erf

    weights = passbands.weights(band)
    steps = np.diff(weights, prepend=0.0, append=0.0)
    edges = np.append(band.wavelength, band.wavelength[-1] + 1.0) - 0.5
    level = np.cumsum(steps)
    margin = _LINE_REACH * LINE_SIGMA[-1] / LIGHT_KM_S
    first = float(np.log(edges[0]) - margin)
    count = int((np.log(edges[-1]) + margin - first) / LINE_STEP) + 2
    centre = np.exp(first + LINE_STEP * np.arange(count))
    out = np.empty((count, len(LINE_SIGMA)), np.float32)
    for k, sigma in enumerate(LINE_SIGMA / LIGHT_KM_S):
        width = sigma * centre
        low = np.searchsorted(edges, centre - _LINE_REACH * width)
        index = low[:, None] + np.arange(int(2.0 * _LINE_REACH * width[-1]) + 2)
        inside = index < len(edges)
        index = np.minimum(index, len(edges) - 1)
        cumulative = 0.5 * (1.0 + erf((centre[:, None] - edges[index]) / (np.sqrt(2.0) * width[:, None])))
        # All steps further down have been passed by the whole line.
        out[:, k] = np.where(low > 0, level[low - 1], 0.0) + (np.where(inside, steps[index], 0.0) * cumulative).sum(1)
    return {"first": np.array([first]), "lines": out}


def _shift_weights(position: Float, weights: Float) -> tuple[int, Float]:
    """Weights [m, n] of linear interpolation at positions [n], summed on the whole ones: (first, [m, w])."""
    index = np.floor(position).astype(np.int64)
    fraction = position - index
    low, width = int(index[0]), int(index[-1] - index[0]) + 2
    index -= low
    shifted = [
        np.bincount(index, w * (1.0 - fraction), width) + np.bincount(index + 1, w * fraction, width) for w in weights
    ]
    return low, np.stack(shifted)


def _to_coefficients(count: int) -> Float:
    """Matrix from values at the nodes to coefficients: at the nodes the polynomials are orthogonal."""
    return np.asarray(
        chebyshev(chebyshev_nodes(count, 1.0), 1.0, count).T * np.where(np.arange(count) > 0, 2.0, 1.0)[:, None] / count
    )
