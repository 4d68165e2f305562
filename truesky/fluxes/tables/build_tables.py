"""Build the tables of fluxes. They take seconds to compute, and are then memory-mapped from the cache."""

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

# Range of the tables of galaxies: all redshifts that a request may have, with peculiar velocities.
Z_FIRST, Z_LAST = -0.021, 3.03
EBV_LAST, A_V_LAST = 0.6, 1.55
# Stars behind more dust (A(V) in mag) are integrated.
STAR_A_V_LAST = 5.0
STAR_COEFFICIENTS = 12

# Tabulated widths of lines, km/s. Values between them are interpolated linearly in sigma^2.
LINE_SIGMA = lines.SIGMA_MIN * 2.0 ** (np.arange(13) / 4.0)
LINE_STEP = 25.0 / LIGHT_KM_S
_LINE_REACH = 6.0


@dataclass(frozen=True, slots=True)
class Setting:
    """Resolution of a table of galaxies.

    Attributes
    ----------
    step : float
        Step in ln(1 + z).
    n_ebv, n_av : int
        Number of Chebyshev coefficients in E(B-V) and in A(V).
    """

    step: float
    n_ebv: int
    n_av: int

    @property
    def z_count(self) -> int:
        """Return the number of nodes in redshift."""
        return int(np.ceil((np.log1p(Z_LAST) - np.log1p(Z_FIRST)) / self.step)) + 1

    @property
    def size(self) -> int:
        """Return the number of coefficients per template and law."""
        return self.z_count * self.n_ebv * self.n_av

    def log_z(self, node: int) -> float:
        """Return ln(1 + z) of a node."""
        return float(np.log1p(Z_FIRST)) + self.step * node


@lru_cache(maxsize=4)
def library_key(library: Library) -> str:
    """Return the key of a library's spectra and extinction laws; takes a tenth of a second once per library."""
    absorbed = [code_key(intergalactic.__name__)] if library.intergalactic else []
    return cache.content_key(library.wavelength, np.asarray(library.flux), dust_curves(library), *absorbed)


def galaxy_table(band: Passband, library: Library, setting: Setting, key: str) -> Float32:
    """Return the table of ln(f_nu in the band at z / f_nu in the reference band at rest), both behind dust.

    Parameters
    ----------
    band : Passband
        The passband.
    library : Library
        Templates of galaxies.
    setting : Setting
        Resolution of the table.
    key : str
        `library_key` of the library.

    Returns
    -------
    float32 array, shape (n_template, 4, n_z, n_ebv * n_av)
        Chebyshev coefficients for laws 1 to 4. At E(B-V) = 0 each law stands for no dust.
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
    """Return the table of ln(f_nu) of each star in units of its spectrum.

    Parameters
    ----------
    band : Passband
        The passband.
    library : Library
        Templates of stars.
    key : str
        `library_key` of the library.

    Returns
    -------
    float32 array, shape (n_template, 12)
        Chebyshev coefficients in A(V).

    Notes
    -----
    The error is 1e-6 (tests/truesky/fluxes/tables/test_flux_tables.py).
    """
    full_key = cache.content_key(code_key(__name__), key, *_curve_arrays(band))
    arrays = cache.cached_arrays(
        f"star_table_{band.name}", full_key, lambda: {"stars": _compute_star_table(library, band)}
    )
    return arrays["stars"]


def line_table(band: Passband) -> tuple[float, Float32]:
    """Return the table of the f_nu in a band of a line with unit flux, by wavelength and width.

    Parameters
    ----------
    band : Passband
        The passband.

    Returns
    -------
    first : float
        ln(first wavelength / A).
    table : float32 array, shape (n_lambda, n_sigma)
        f_nu in erg s-1 cm-2 Hz-1, in steps of LINE_STEP in ln(lambda) and for the widths LINE_SIGMA.
    """
    full_key = cache.content_key(code_key(__name__), LINE_SIGMA, *_curve_arrays(band))
    arrays = cache.cached_arrays(f"line_table_{band.name}", full_key, lambda: _compute_line_table(band))
    return float(arrays["first"][0]), arrays["lines"]


def chebyshev_nodes(count: int, last: float) -> Float:
    """Return Chebyshev nodes in [0, last]; a single node is at 0, for the flux before dust."""
    if count == 1:
        return np.zeros(1)
    return np.asarray(0.5 * last * (1.0 + np.cos(np.pi * (np.arange(count) + 0.5) / count)))


def chebyshev(values: Float, last: float, count: int) -> Float:
    """Return Chebyshev polynomials T_0 to T_(count - 1) on [0, last].

    Parameters
    ----------
    values : float array
        Arguments, 0 to `last`.
    last : float
        End of the interval.
    count : int
        Number of polynomials.

    Returns
    -------
    float array, shape (..., count)
        The polynomials.
    """
    return np.asarray(np.polynomial.chebyshev.chebvander(2.0 * values / last - 1.0, count - 1))


def _curve_arrays(band: Passband) -> tuple[Float, Float]:
    return band.wavelength, band.response


def _compute_galaxy_table(library: Library, band: Passband, reference: Passband, setting: Setting) -> Float32:
    """Compute the table with shifted weights: at each redshift the band's weights are shifted once for all spectra."""
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
    # Sums run over wavelength, so it becomes the first axis.
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
    # Templates without flux in the far ultraviolet get the smallest flux of single precision.
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
    # Cool stars may have no flux in the ultraviolet.
    f_nu = np.maximum(f_nu, np.finfo(float).tiny)
    return np.asarray(matrices.matmul(np.log(f_nu), _to_coefficients(STAR_COEFFICIENTS).T), np.float32)


def _compute_line_table(band: Passband) -> dict[str, npt.NDArray[np.generic]]:
    """Convolve the band's weights, constant over each bin of 1 A, with Gaussians."""
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
        # The whole line is redward of all edges below `low`.
        out[:, k] = np.where(low > 0, level[low - 1], 0.0) + (np.where(inside, steps[index], 0.0) * cumulative).sum(1)
    return {"first": np.array([first]), "lines": out}


def _shift_weights(position: Float, weights: Float) -> tuple[int, Float]:
    """Distribute weights [m, n] at positions [n] over neighbouring whole positions: (first, [m, w]).

    The sum over the result is the sum over linear interpolations at the positions.
    """
    index = np.floor(position).astype(np.int64)
    fraction = position - index
    low, width = int(index[0]), int(index[-1] - index[0]) + 2
    index -= low
    shifted = [
        np.bincount(index, w * (1.0 - fraction), width) + np.bincount(index + 1, w * fraction, width) for w in weights
    ]
    return low, np.stack(shifted)


def _to_coefficients(count: int) -> Float:
    """Return the matrix that converts values at the nodes to coefficients; the polynomials are orthogonal there."""
    return np.asarray(
        chebyshev(chebyshev_nodes(count, 1.0), 1.0, count).T * np.where(np.arange(count) > 0, 2.0, 1.0)[:, None] / count
    )
