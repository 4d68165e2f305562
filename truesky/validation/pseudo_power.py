"""Measure angular power spectra of maps that cover part of the sky, corrected for the mask (MASTER).

A mask mixes multipoles: the mean power spectrum of the masked map is M C_l with a coupling matrix M that follows from
the power spectrum of the mask. Spectra are averaged in bands and divided by the coupling of the bands. Maps are HEALPix
maps in the ring scheme, already multiplied by their masks.

References
----------
Hivon et al. 2002, ApJ 567, 2 (MASTER)
Alonso, Sanchez & Slosar 2019, MNRAS 484, 4127, sections 2.1 and 2.2 (windows of bands)
Efstathiou 2004, MNRAS 349, 603 (covariance)
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import j0

from lake_schema import sky
from lake_schema.arrays import Float, Int
from lake_schema.ids import GENERATION_ORDER
from lake_schema.lazy_healpy import healpy as hp
from truesky.numerics import matrices

# Largest multipole of spectra. Maps have cells of order 8 (N_side = 256), and power beyond it is not corrected for.
L_MAX = 512
# Number of cells whose window is averaged, and orders of the points in them above that of the cells.
_WINDOW_CELLS, _FINER = 12, 4
# Highest multipole of the spectrum of a mask.
_MASK_L_MAX = 767


@dataclass(frozen=True, slots=True, eq=False)
class Bands:
    """Power spectra in bands of multipoles on a part of the sky.

    Attributes
    ----------
    edges : int array, shape (b + 1,)
        First multipole of each band, and the one after the last band.
    windows : float array, shape (b, L_MAX + 1)
        Windows of the bands: the expected value of a band is the sum of window times C_l.
    from_pseudo : float array, shape (b, L_MAX + 1)
        Factors with which the spectrum of masked maps gives the values of the bands.
    coupling : float array, shape (b, L_MAX + 1)
        Mean spectrum of masked maps in each band per C_l.
    scatter : float array, shape (b, b)
        Covariance of the mean spectra of masked maps in two bands, for independent Gaussian maps with C_l = 1.
    """

    edges: Int
    windows: Float
    from_pseudo: Float
    coupling: Float
    scatter: Float

    @property
    def middle(self) -> Float:
        """Return the mean multipole of each band."""
        return np.asarray(0.5 * (self.edges[1:] + self.edges[:-1] - 1))

    def measure(self, pseudo: Float) -> Float:
        """Return the values of the bands for the power spectrum of masked maps, shape (L_MAX + 1,)."""
        return np.asarray(np.sum(self.from_pseudo * pseudo, axis=1))

    def expect(self, c_l: Float) -> Float:
        """Return the expected values of the bands for C_l of the whole sky at l = 0 to L_MAX."""
        return np.asarray(np.sum(self.windows * c_l, axis=1))

    def mix(self, c_l: Float) -> Float:
        """Return the mean spectrum of masked maps in each band, for C_l of the whole sky at l = 0 to L_MAX."""
        return np.asarray(np.sum(self.coupling * c_l, axis=1))

    def covariance(self, first: Float, second: Float, cross: Float) -> Float:
        """Return the covariance of the values of the bands for Gaussian maps.

        Parameters
        ----------
        first, second, cross : float array, shape (b,)
            Spectra of both maps with noise, and their cross spectrum, as they are in the mask: `mix` divided by the
            mean product of both masks. The cross spectrum of a map with itself is its spectrum.

        Returns
        -------
        float array, shape (b, b)
            Covariance, for spectra that change little within the resolution of the mask (Efstathiou 2004).
        """
        both = np.sqrt(np.maximum(first * second, 0.0))
        means = self.scatter * (both[:, None] * both + cross[:, None] * cross)
        from_means = np.ascontiguousarray(self.from_pseudo[:, self.edges[:-1]] * np.diff(self.edges))
        return np.asarray(matrices.matmul(matrices.matmul(from_means, means), np.ascontiguousarray(from_means.T)))


def map_of_cells(cells: Int, values: Float) -> Float:
    """Return the map with values in nested cells of order 8, and 0 elsewhere, in the ring scheme."""
    full = np.zeros(12 << 2 * GENERATION_ORDER)
    full[hp.nest2ring(1 << GENERATION_ORDER, cells)] = values
    return full


@lru_cache(maxsize=1)
def pixel_window() -> Float:
    """Return the factor by which means over cells of order 8 reduce the amplitude of multipoles 0 to L_MAX.

    Its square is the mean of P_l over all pairs of points in a cell, averaged over cells. healpy would download a file.
    """
    cells = ((np.arange(_WINDOW_CELLS) + 0.37) * (12 << 2 * GENERATION_ORDER) / _WINDOW_CELLS).astype(np.int64)
    inside = (cells[:, None] << 2 * _FINER) + np.arange(1 << 2 * _FINER)
    place = sky.unit_vectors(*sky.cell_centres(GENERATION_ORDER + _FINER, inside))
    chord = np.sqrt(np.sum((place[:, :, None] - place[:, None]) ** 2, -1))
    nodes = np.arange(0, L_MAX + 1, 16)
    square = [np.mean(j0((n + 0.5) * 2.0 * np.arcsin(0.5 * chord))) for n in nodes]
    window: Float = np.sqrt(np.interp(np.arange(L_MAX + 1), nodes, square))
    window.flags.writeable = False
    return window


def power_of_maps(first: Float, second: Float | None = None) -> Float:
    """Return the power spectrum of a masked map, or the cross spectrum of two, at l = 0 to L_MAX."""
    return np.asarray(hp.anafast(first, second, lmax=L_MAX, iter=3))


def bands(first_mask: Float, second_mask: Float, edges: Int, is_centred: bool = False) -> Bands:
    """Return the bands of cross spectra of maps with two masks, which may be equal.

    Parameters
    ----------
    first_mask, second_mask : float array, shape (pixels,)
        Weights by which the maps were multiplied.
    edges : int array, shape (b + 1,)
        First multipole of each band, and the one after the last band; ascending, from 2 or more to L_MAX + 1.
    is_centred : bool, optional
        True if each map is mask times (values - mean), with the mean of the values weighted by the mask. This removes
        power on the scales of the mask.

    Returns
    -------
    Bands
        The bands. Those below the resolution of the mask have large errors.
    """
    # The spectrum of one mask takes half as long as the cross spectrum of two equal ones.
    second = None if np.array_equal(first_mask, second_mask) else second_mask
    l_max = min(_MASK_L_MAX, 3 * hp.get_nside(first_mask) - 1)
    mask_power = hp.anafast(first_mask, second, lmax=l_max, iter=3)
    coupling = coupling_matrix(mask_power, L_MAX)
    ell = np.arange(L_MAX + 1)
    inside = (ell >= edges[:-1, None]) & (ell < edges[1:, None])
    mean = inside / inside.sum(1)[:, None]
    binned = matrices.matmul(mean, coupling)
    if is_centred:
        binned -= removed_by_means(first_mask, second_mask, mean)
    coupled = matrices.matmul(binned, inside.T.astype(float))
    product_power = hp.anafast(first_mask * second_mask, lmax=l_max, iter=3)
    modes = coupling_matrix(product_power, L_MAX) / (2.0 * ell + 1.0)
    scatter = matrices.matmul(matrices.matmul(mean, modes), np.ascontiguousarray(mean.T))
    windows, from_pseudo = (matrices.least_squares(coupled, values) for values in (binned, mean))
    return Bands(edges, windows, from_pseudo, binned, scatter)


def removed_by_means(first_mask: Float, second_mask: Float, mean: Float) -> Float:
    """Return what the coupling of multipoles loses if the mean in the mask is subtracted from both maps.

    Parameters
    ----------
    first_mask, second_mask : float array, shape (pixels,)
        Weights by which the maps were multiplied, and with which their means were computed.
    mean : float array, shape (b, L_MAX + 1)
        Weight of each multipole in each band, with a sum of 1.

    Returns
    -------
    float array, shape (b, L_MAX + 1)
        Mean spectrum that the masked maps lose in each band, per C_l' of the whole sky.

    Notes
    -----
    For masks w and v with areas A and B, the maps are w (f - int w f / A) and v (g - int v g / B). With w_l for the
    part of w at multipole l, and S_l for the sum of w_lm v_lm* over m, the mean of the spectrum at l loses, per C_l',
    [int w v_l v_l' / B + int v w_l w_l' / A - S_l S_l' / (A B)] / (2 l + 1).
    """
    nside, number = hp.get_nside(first_mask), 2.0 * np.arange(L_MAX + 1) + 1.0
    l_max = min(L_MAX, 3 * nside - 1)
    modes = [hp.map2alm(mask, lmax=l_max, iter=3) for mask in (first_mask, second_mask)]
    areas = [4.0 * np.pi * float(np.mean(mask)) for mask in (first_mask, second_mask)]
    both = _fill_to_l_max(hp.alm2cl(*modes)) * number
    lost = -np.sum(mean * both / number, axis=1)[:, None] * both / (areas[0] * areas[1])
    pairs = [(first_mask, modes[1], areas[1]), (second_mask, modes[0], areas[0])]
    if np.array_equal(first_mask, second_mask):
        pairs = [(2.0 * first_mask, modes[0], areas[0])]
    for other, mask_modes, area in pairs:
        for row, weight in zip(lost, mean / number, strict=True):
            part = other * hp.alm2map(hp.almxfl(mask_modes, weight), nside, l_max)
            row += _fill_to_l_max(hp.alm2cl(hp.map2alm(part, lmax=l_max, iter=0), mask_modes)) * number / area
    return np.asarray(lost)


def _fill_to_l_max(c_l: Float) -> Float:
    """Return a spectrum with zeros beyond its end, to L_MAX."""
    return np.asarray(np.pad(c_l, (0, L_MAX + 1 - len(c_l))))


def coupling_matrix(mask_power: Float, l_max: int) -> Float:
    """Return the matrix with which a mask couples multipoles.

    Parameters
    ----------
    mask_power : float array, shape (m,)
        Power spectrum of the mask, or cross spectrum of two masks, from l = 0.
    l_max : int
        Largest multipole of the result.

    Returns
    -------
    float array, shape (l_max + 1, l_max + 1)
        Mean spectrum of the masked map at each l (rows) per C_l' of the whole sky (columns).

    Notes
    -----
    Hivon et al. write it as a sum over Wigner 3j symbols. Their squares are integrals of three Legendre polynomials,
    so that M = (2 l' + 1) / 2 times the integral of P_l P_l' w, with the correlation function w of the mask. The
    quadrature is exact.
    """
    x, weights = _nodes((2 * l_max + len(mask_power)) // 2 + 1)
    order = max(l_max, len(mask_power) - 1)
    legendre = np.empty((order + 1, len(x)))
    legendre[0], legendre[1:2] = 1.0, x
    for n in range(2, order + 1):
        legendre[n] = ((2 * n - 1) * x * legendre[n - 1] - (n - 1) * legendre[n - 2]) / n
    factors = (2.0 * np.arange(len(mask_power)) + 1.0) * mask_power / (4.0 * np.pi)
    correlation = np.sum(factors[:, None] * legendre[: len(mask_power)], axis=0)
    polynomials = legendre[: l_max + 1]
    products = matrices.matmul(polynomials * (weights * correlation), np.ascontiguousarray(polynomials.T))
    return np.asarray(products * (2.0 * np.arange(l_max + 1) + 1.0) / 2.0)


@lru_cache(maxsize=2)
def _nodes(count: int) -> tuple[Float, Float]:
    return matrices.gauss_legendre(count)
