"""Build tables in which fluxes of galaxies, stars and emission lines are interpolated.

Tables take seconds to compute. They are kept in a cache on disc, from which they are memory-mapped.
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
from truesky.numerics import cache, cache_labels, matrices
from truesky.numerics.code_fingerprints import code_key

# Smallest and largest redshift of the tables of galaxies. Fluxes of galaxies at other redshifts are integrated.
Z_FIRST, Z_LAST = -0.021, 3.03
# Largest E(B-V) of the tables for dust in galaxies, mag. Fluxes of galaxies with more dust are integrated.
EBV_LAST = 0.6
# Largest A(V) of the tables for the Milky Way in front of galaxies, mag. Fluxes behind more dust are integrated.
A_V_LAST = 1.55
# Largest A(V) of the tables of stars, mag. Fluxes of stars behind more dust are integrated.
STAR_A_V_LAST = 5.0
# Number of Chebyshev coefficients in A(V) of the tables of stars.
STAR_COEFFICIENTS = 12

# Tabulated Gaussian sigma of lines, km/s. Between them, fluxes are interpolated linearly in sigma^2.
LINE_SIGMA = lines.SIGMA_MIN * 2.0 ** (np.arange(13) / 4.0)
# Step of the line tables in ln(lambda): 25 km/s.
LINE_STEP = 25.0 / LIGHT_KM_S
# Half-width of a line profile in units of sigma.
_LINE_REACH = 6.0


@dataclass(frozen=True, slots=True)
class Setting:
    """Resolution of a flux table of galaxies.

    Attributes
    ----------
    step : float
        Distance of the redshift nodes in ln(1 + z).
    n_ebv, n_av : int
        Number of Chebyshev coefficients in E(B-V) and in A(V).
    """

    step: float
    n_ebv: int
    n_av: int

    @property
    def z_count(self) -> int:
        """Return the number of redshift nodes, from `Z_FIRST` to `Z_LAST`."""
        return int(np.ceil((np.log1p(Z_LAST) - np.log1p(Z_FIRST)) / self.step)) + 1

    @property
    def size(self) -> int:
        """Return the number of Chebyshev coefficients per template and extinction law, over all redshift nodes."""
        return self.z_count * self.n_ebv * self.n_av

    def log_z(self, node: int) -> float:
        """Return ln(1 + z) of a redshift node; node 0 is at `Z_FIRST`."""
        return float(np.log1p(Z_FIRST)) + self.step * node


@lru_cache(maxsize=4)
def library_key(library: Library) -> str:
    """Return a hash of a library's spectra and extinction laws, which identifies its tables in the cache.

    The first call for a library takes a tenth of a second.
    """
    absorbed = [code_key(intergalactic.__name__)] if library.intergalactic else []
    return cache.content_key(library.wavelength, np.asarray(library.flux), dust_curves(library), *absorbed)


def galaxy_table(band: Passband, library: Library, setting: Setting, key: str) -> Float32:
    """Return a table of ln(observed f_nu in a band / rest-frame f_nu in the reference band) of each template.

    The numerator includes redshift, internal dust and Milky Way dust; the denominator includes internal dust only.

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
        Chebyshev coefficients for extinction laws 1 to 4. At E(B-V) = 0 all four laws give the template without dust.
    """
    reference = passbands.load(REFERENCE_BAND)
    numbers = (setting.step, setting.n_ebv, setting.n_av)
    full_key = cache.content_key(code_key(__name__), key, *numbers, *_curve_arrays(band), *_curve_arrays(reference))
    arrays = cache.cached_arrays(
        f"galaxy_table_{band.name}",
        full_key,
        lambda: {"galaxies": _compute_galaxy_table(library, band, reference, setting)},
        cache_labels.label_galaxy_table(band.name, *numbers),
    )
    return arrays["galaxies"]


@lru_cache(maxsize=24)
def star_table(band: Passband, library: Library, key: str) -> Float32:
    """Return a table of ln(f_nu in a band) of each stellar template against the A(V) of dust in front of it.

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
        Chebyshev coefficients in A(V), 0 to 5 mag. f_nu is that of the template as stored, before it is scaled.

    Notes
    -----
    The relative error of f_nu is 1e-6 (tests/truesky/fluxes/tables/test_flux_tables.py).
    """
    full_key = cache.content_key(code_key(__name__), key, *_curve_arrays(band))
    arrays = cache.cached_arrays(
        f"star_table_{band.name}",
        full_key,
        lambda: {"stars": _compute_star_table(library, band)},
        cache_labels.label_star_table(band.name),
    )
    return arrays["stars"]


def line_table(band: Passband) -> tuple[float, Float32]:
    """Return a table of the f_nu in a band of an emission line with flux 1 erg s-1 cm-2, by wavelength and width.

    Parameters
    ----------
    band : Passband
        The passband.

    Returns
    -------
    first : float
        ln(wavelength / A) of the first row.
    table : float32 array, shape (n_lambda, n_sigma)
        f_nu in erg s-1 cm-2 Hz-1. Rows are in steps of LINE_STEP in ln(lambda); columns are the widths LINE_SIGMA.
    """
    full_key = cache.content_key(code_key(__name__), LINE_SIGMA, *_curve_arrays(band))
    arrays = cache.cached_arrays(f"line_table_{band.name}", full_key, lambda: _compute_line_table(band))
    return float(arrays["first"][0]), arrays["lines"]


def chebyshev_nodes(count: int, last: float) -> Float:
    """Return `count` Chebyshev nodes in [0, last], in decreasing order.

    If `count` is 1, the node is 0 instead of the middle, so that a table with one coefficient has the flux before dust.
    """
    if count == 1:
        return np.zeros(1)
    return np.asarray(0.5 * last * (1.0 + np.cos(np.pi * (np.arange(count) + 0.5) / count)))


def chebyshev(values: Float, last: float, count: int) -> Float:
    """Return Chebyshev polynomials T_0 to T_(count - 1) on [0, last].

    Parameters
    ----------
    values : float array
        Arguments, 0 to `last`; the range is not checked.
    last : float
        Upper end of the interval.
    count : int
        Number of polynomials.

    Returns
    -------
    float array, shape (..., count)
        The polynomials at each argument.
    """
    return np.asarray(np.polynomial.chebyshev.chebvander(2.0 * values / last - 1.0, count - 1))


def _curve_arrays(band: Passband) -> tuple[Float, Float]:
    return band.wavelength, band.response


def _compute_galaxy_table(library: Library, band: Passband, reference: Passband, setting: Setting) -> Float32:
    """Compute the coefficients of `galaxy_table`.

    At each redshift, the band's weights are shifted to the rest frame once, instead of redshifting every spectrum.
    """
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
    # Make wavelength the first axis, because sums run over it.
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
    # Replace 0 by the smallest positive float32 before the logarithm: some templates have no flux in the far
    # ultraviolet.
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
    # Replace 0 by the smallest positive number before the logarithm: cool stars may have no flux in the ultraviolet.
    f_nu = np.maximum(f_nu, np.finfo(float).tiny)
    return np.asarray(matrices.matmul(np.log(f_nu), _to_coefficients(STAR_COEFFICIENTS).T), np.float32)


def _compute_line_table(band: Passband) -> dict[str, npt.NDArray[np.generic]]:
    """Compute the arrays of `line_table` by convolution of the band's weights with Gaussian line profiles.

    Weights are constant over each bin of 1 A.
    """
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
        # The weight at a wavelength is the sum of the weight steps at all bin edges blueward of it. Edges before index
        # `low` are blueward of the whole line, so that the sum of their steps, `level`, applies to all of its flux.
        out[:, k] = np.where(low > 0, level[low - 1], 0.0) + (np.where(inside, steps[index], 0.0) * cumulative).sum(1)
    return {"first": np.array([first]), "lines": out}


def _shift_weights(position: Float, weights: Float) -> tuple[int, Float]:
    """Distribute m sets of weights at n fractional positions, in increasing order, over the neighbouring integers.

    Returns the first integer and the new weights, float64[m, w], for successive integers. The weighted sum of a
    spectrum at the integers equals the weighted sum of its linear interpolation at the fractional positions.
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
    """Return the matrix that converts values at Chebyshev nodes to Chebyshev coefficients, float64[count, count].

    The matrix follows from the orthogonality of the polynomials at the nodes.
    """
    return np.asarray(
        chebyshev(chebyshev_nodes(count, 1.0), 1.0, count).T * np.where(np.arange(count) > 0, 2.0, 1.0)[:, None] / count
    )
