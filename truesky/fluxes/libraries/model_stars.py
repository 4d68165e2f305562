"""Compute spectra of stars by temperature, gravity and metallicity, and describe stars as mixtures of these spectra.

A model is the spectrum at a node (Teff, log g, [M/H]). Models have the colours of Castelli & Kurucz 2003
(model_stars.csv, which lists the sources). At the hottest nodes, and at the coolest nodes of dwarfs, they change
smoothly into the dwarf spectra of the module `stellar`, which continue to hotter and cooler stars. Cells between nodes
are divided into simplices (tetrahedra). A star is a mixture of the four corners of its simplex. The mixture is linear
and continuous in ln Teff, log g and [M/H].
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from lake_schema.arrays import Float, Int
from truesky.fluxes import passbands
from truesky.fluxes.libraries import stellar
from truesky.fluxes.libraries.stellar import StellarTypes
from truesky.numerics.compiling import exact_jit

TABLE = Path(__file__).with_name("model_stars.csv")
TEFF = np.geomspace(3600.0, 8500.0, 18)
LOG_G = np.array([1.6, 3.2, 4.6])
METALLICITY = np.array([-2.5, -1.5, -1.0, -0.5, 0.0, 0.5])
# Number of spectra that are mixed for a star.
MIXTURE_SIZE = 4
BANDS = ("sdss_u", "sdss_g", "sdss_r", "sdss_i", "sdss_z", "twomass_j", "twomass_h", "twomass_ks")
_DWARF_GRAVITY = len(LOG_G) - 1
# Fraction of the model in the spectrum at the two hottest temperatures, hottest first. The rest is a dwarf spectrum.
_HOT_SHARES = (0.0, 0.5)
# Fraction of the model in the spectrum at the three coolest temperatures, coolest first, for nodes with the gravity of
# dwarfs. The rest is a dwarf spectrum.
_COOL_SHARES = (0.0, 1 / 3, 2 / 3)
# Largest log g of giants. Stars cooler than all models use the coolest models if they are giants, else dwarf spectra.
_GIANT = 3.9
_V = "bessell_v"
# Largest error of a colour (mag), and largest number of iterations of the search for a spectrum with given colours.
_TOLERANCE = 1e-4, 100


@dataclass(frozen=True, slots=True, eq=False)
class Models:
    """Colours of the models at all nodes of temperature, gravity and metallicity.

    Attributes
    ----------
    bolometric_h : float array, shape (n_teff, n_log_g, n_metallicity)
        Bolometric correction of the H band, M_bol - M_H (AB), in mag.
    colors : float array, shape (n_teff, n_log_g, n_metallicity, 8)
        Colours m_band - m_V (AB) of the passbands `BANDS` in mag.
    """

    bolometric_h: Float
    colors: Float


@dataclass(frozen=True, slots=True)
class Mixture:
    """The mixture of template spectra that represents each of n stars.

    Attributes
    ----------
    sed : int array, shape (MIXTURE_SIZE, n)
        Indices of the templates in the stellar library.
    frac : float array, shape (MIXTURE_SIZE, n)
        Fraction of each template in f_lambda at 5500 A; 0 for a template that is not used.
    """

    sed: Int
    frac: Float


@lru_cache(maxsize=1)
def models() -> Models:
    """Read the colours of the models from model_stars.csv."""
    with TABLE.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    shape = (TEFF.size, LOG_G.size, METALLICITY.size)
    colors = np.array([[float(row[band]) for band in BANDS] for row in rows])
    bolometric = np.array([float(row["bolometric_h"]) for row in rows])
    return Models(bolometric.reshape(shape), colors.reshape(*shape, len(BANDS)))


def names() -> tuple[str, ...]:
    """Return a label with Teff, log g and [M/H] of each model, such as "3600 K 1.6 -2.5"; [M/H] varies fastest."""
    return tuple(f"{t:.0f} K {g:.1f} {z:+.1f}" for t in TEFF for g in LOG_G for z in METALLICITY)


@lru_cache(maxsize=1)
def model_share() -> Float:
    """Return the fraction of the model in the spectrum at each node; the rest is the spectrum of a dwarf.

    The axes are temperature, gravity and metallicity.
    """
    share = np.ones((TEFF.size, LOG_G.size, METALLICITY.size))
    for k, value in enumerate(_HOT_SHARES):
        share[-1 - k] *= value
    for k, value in enumerate(_COOL_SHARES):
        share[k, _DWARF_GRAVITY] *= value
    return share


def spectra(dwarfs: Float, types: StellarTypes) -> Float:
    """Return the normalised spectra of the models at 600 to 24000 A (passbands.grid()).

    Parameters
    ----------
    dwarfs : float array, shape (m, 23401)
        f_lambda of the dwarf types, with mean 1 between 5450 and 5550 A.
    types : StellarTypes
        The m dwarf types.

    Returns
    -------
    float array, shape (n, 23401)
        f_lambda of each model in the order of `names`, with mean 1 between 5450 and 5550 A.

    Notes
    -----
    At nodes without a contribution of dwarfs, colours differ from the values in model_stars.csv by at most 1e-4 mag.
    """
    grid, table, share = passbands.grid(), models(), model_share()
    bands = [passbands.load(name) for name in (*BANDS, _V)]
    pivots = np.array([passbands.pivot_wavelength(band) for band in bands])
    order = np.argsort(pivots)
    response = np.zeros((grid.size, len(bands)))
    for k, band in enumerate(bands):
        response[band.first : band.first + len(band.wavelength), k] = passbands.weights(band)
    reference = int(np.flatnonzero(order == len(BANDS))[0])
    out, interpolated_dwarfs = [], dwarf_spectra(dwarfs, types)
    for i, teff in enumerate(TEFF):
        start = stellar.planck(grid, teff) * stellar.feature_transmission(grid, teff)
        first = np.zeros(len(bands))
        dwarf = interpolated_dwarfs[i * LOG_G.size * METALLICITY.size]
        for j in range(LOG_G.size):
            for k in range(METALLICITY.size):
                target_colors = np.append(table.colors[i, j, k], 0.0)[order]
                args = (
                    np.log(grid),
                    start,
                    response[:, order],
                    np.log(pivots[order]),
                    target_colors,
                    reference,
                    _TOLERANCE,
                )
                first = stellar.color_correction(*args, first)
                model = stellar.normalise(
                    grid, stellar.apply_correction(np.log(grid), start, np.log(pivots[order]), first)
                )
                out.append(share[i, j, k] * model + (1.0 - share[i, j, k]) * dwarf)
    return stellar.normalise(grid, np.stack(out))


def dwarf_spectra(dwarfs: Float, types: StellarTypes) -> Float:
    """Interpolate spectra of dwarfs to the temperatures of the models, linearly in ln Teff.

    Parameters
    ----------
    dwarfs : float array, shape (k, m)
        Spectra of the k dwarf types.
    types : StellarTypes
        The dwarf types.

    Returns
    -------
    float array, shape (n, m)
        Spectrum of a dwarf with the temperature of each model. Models that differ only in gravity or metallicity have
        the same one.
    """
    neighbours, weight = _neighbour_dwarfs(types, TEFF)
    interpolated = (1.0 - weight)[:, None] * dwarfs[neighbours[0]] + weight[:, None] * dwarfs[neighbours[1]]
    return np.repeat(interpolated, LOG_G.size * METALLICITY.size, axis=0)


def nearest_dwarfs(types: StellarTypes) -> Int:
    """Return for each model the index of the next hotter dwarf type, int64[n]."""
    return np.repeat(_neighbour_dwarfs(types, TEFF)[0][0], LOG_G.size * METALLICITY.size)


def mixture(types: StellarTypes, first: int, teff: Float, log_g: Float, metallicity: Float) -> Mixture:
    """Return the mixture of up to four template spectra that represents each star.

    Parameters
    ----------
    types : StellarTypes
        The dwarf types, whose templates are the first of the stellar library.
    first : int
        Index of the first model in the stellar library.
    teff : float array, shape (n,)
        Effective temperature in K.
    log_g : float array, shape (n,)
        Surface gravity, log10 of cm s-2.
    metallicity : float array, shape (n,)
        [M/H] in dex.

    Returns
    -------
    Mixture
        Indices and fractions, for each star with the largest fraction first. Temperatures beyond the dwarfs, and
        gravities and metallicities beyond the models, are clipped.
    """
    n = teff.size
    sed, frac = np.zeros((MIXTURE_SIZE, n), np.int64), np.zeros((MIXTURE_SIZE, n))
    t, g, z = (np.ascontiguousarray(values, float) for values in (teff, log_g, metallicity))
    _mix(t, g, z, np.log(TEFF), LOG_G, METALLICITY, np.log(types.teff), first, _GIANT, sed, frac)
    return Mixture(sed, frac)


def bolometric_h(types: StellarTypes, vega: float, teff: Float, log_g: Float, metallicity: Float) -> Float:
    """Return the bolometric correction M_bol - M_H (Vega) of stars.

    Parameters
    ----------
    types : StellarTypes
        The dwarf types.
    vega : float
        AB magnitude of Vega in the H band.
    teff : float array, shape (n,)
        Effective temperature in K.
    log_g : float array, shape (n,)
        Surface gravity, log10 of cm s-2.
    metallicity : float array, shape (n,)
        [M/H] in dex.

    Returns
    -------
    float array, shape (n,)
        M_bol - M_H in mag, averaged over the templates of each star's mixture.
    """
    mixed = mixture(types, types.teff.size, teff, log_g, metallicity)
    of_models = model_share() * (models().bolometric_h + vega)
    dwarf = np.interp(-np.log(TEFF), -np.log(types.teff), types.bolometric_h)
    values = np.concatenate([types.bolometric_h, (of_models + (1.0 - model_share()) * dwarf[:, None, None]).ravel()])
    return np.asarray((mixed.frac * values[mixed.sed]).sum(0))


def v_minus_h(types: StellarTypes, vega: tuple[float, float]) -> Float:
    """Return the colour V - H (Vega) of all dwarf types, followed by that of all models.

    Parameters
    ----------
    types : StellarTypes
        The dwarf types.
    vega : (float, float)
        AB magnitudes of Vega in V and H.

    Returns
    -------
    float array, shape (m,)
        Colours in mag. The error is 0.02 mag, due to the interpolation of the dwarfs' H to the models' temperatures.
    """
    of_models = -models().colors[..., BANDS.index("twomass_h")] - vega[0] + vega[1]
    dwarf = np.interp(-np.log(TEFF), -np.log(types.teff), types.v_minus_h)[:, None, None]
    share = model_share()
    light = share * 10.0 ** (0.4 * of_models) + (1.0 - share) * 10.0 ** (0.4 * dwarf)
    return np.concatenate([types.v_minus_h, 2.5 * np.log10(light).ravel()])


def _neighbour_dwarfs(types: StellarTypes, teff: Float) -> tuple[Int, Float]:
    """Return the dwarf types next to each temperature (K), and the weight of the cooler one, linear in ln Teff.

    The types are the indices of the hotter and the cooler neighbour, int64[2, n]. The weight, float64[n], is limited to
    0 to 1 for temperatures beyond the dwarfs.
    """
    ln_teff = np.log(types.teff)
    cooler = np.clip(np.searchsorted(-ln_teff, -np.log(teff)), 1, ln_teff.size - 1)
    weight = (ln_teff[cooler - 1] - np.log(teff)) / (ln_teff[cooler - 1] - ln_teff[cooler])
    return np.stack([cooler - 1, cooler]), np.clip(weight, 0.0, 1.0)


@exact_jit
def _mix(
    teff: Float, log_g: Float, metallicity: Float, ln_teff: Float, gravities: Float, metals: Float, dwarfs: Float,
    first: int, giant: float, sed: Int, frac: Float,
) -> None:  # fmt: skip
    """Write the template indices and fractions of each star's mixture to `sed` and `frac`, shape (MIXTURE_SIZE, n).

    `ln_teff`, `gravities` and `metals` are the nodes of the models, and `dwarfs` is ln Teff of the dwarf types,
    decreasing. `first` is the index of the first model in the library, and `giant` the largest log g of giants.

    Notes
    -----
    A star hotter than all models, or cooler than all models and not a giant, is a mixture of two dwarf types. Any other
    star is a mixture of four models.

    A cell between eight nodes is divided into six simplices (tetrahedra) that share the diagonal of the cell. The
    corners of the star's simplex are on a path along the edges of the cell from the lowest to the highest node. The
    path first takes the axis along which the star is farthest from the lowest node.

    References
    ----------
    Kuhn 1960, IBM J. Res. Dev. 4, 518.
    """
    for i in range(teff.size):
        t = math.log(teff[i])
        if t > ln_teff[-1] or (t < ln_teff[0] and log_g[i] > giant):
            k = min(max(int(np.searchsorted(-dwarfs, -t)), 1), dwarfs.size - 1)
            w = min(max((dwarfs[k - 1] - t) / (dwarfs[k - 1] - dwarfs[k]), 0.0), 1.0)
            sed[0, i], sed[1, i], frac[0, i], frac[1, i] = k - 1, k, 1.0 - w, w
        else:
            a, along = _find_node(ln_teff, t)
            b, up = _find_node(gravities, log_g[i])
            c, rich = _find_node(metals, metallicity[i])
            size_a, size_b = gravities.size * metals.size, metals.size
            # Sort the three axes by decreasing distance of the star from the lowest node of its cell. x, y, z are the
            # distances as fractions of the cell, and p, q, r the steps of the template index along the axes.
            x, y, z = along, up, rich
            p, q, r = size_a, size_b, 1
            if y > x:
                x, y, p, q = y, x, q, p
            if z > y:
                y, z, q, r = z, y, r, q
            if y > x:
                x, y, p, q = y, x, q, p
            at = first + a * size_a + b * size_b + c
            sed[0, i], sed[1, i], sed[2, i], sed[3, i] = at, at + p, at + p + q, at + p + q + r
            frac[0, i], frac[1, i], frac[2, i], frac[3, i] = 1.0 - x, x - y, y - z, z
        best = 0
        for k in range(1, frac.shape[0]):
            if frac[k, i] > frac[best, i]:
                best = k
        sed[0, i], sed[best, i] = sed[best, i], sed[0, i]
        frac[0, i], frac[best, i] = frac[best, i], frac[0, i]


@exact_jit
def _find_node(nodes: Float, value: float) -> tuple[int, float]:
    """Return the index of the node before a value, and the fraction (0 to 1) of the way to the next node.

    `nodes` increase. Values outside the nodes count as the first or last node.
    """
    low = min(max(int(np.searchsorted(nodes, value, side="right")) - 1, 0), nodes.size - 2)
    return low, min(max((value - nodes[low]) / (nodes[low + 1] - nodes[low]), 0.0), 1.0)
