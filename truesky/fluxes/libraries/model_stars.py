"""Spectra of stars by temperature, gravity and metallicity, and stars as mixtures of neighbouring ones.

TEFF, LOG_G, METALLICITY   nodes of the models
names, spectra             the models' part of the stellar library
Mixture, mixture           which spectra a star is made of, and their shares
bolometric_h, v_minus_h    M_bol - M_H, V - H

The models have the colours of Castelli & Kurucz 2003 (model_stars.csv, where the sources stand); at the hottest nodes,
and at the coolest of dwarfs, they go over into the dwarfs of `stellar`, which go on beyond.  A star between nodes is a
mixture of the four corners of the simplex that it lies in, linear and continuous in ln Teff, log g and [M/H].
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
# Spectra that a star is a mixture of.
MIXTURE_SIZE = 4
BANDS = ("sdss_u", "sdss_g", "sdss_r", "sdss_i", "sdss_z", "twomass_j", "twomass_h", "twomass_ks")
_DWARF_GRAVITY = len(LOG_G) - 1
# The models' share at the hottest nodes, from the last, and at a dwarf's coolest, from the first.
_HOT_SHARES, _COOL_SHARES = (0.0, 0.5), (0.0, 1 / 3, 2 / 3)
# Cooler than the models, stars of lower gravity are giants, and take the coolest of them.
_GIANT = 3.9
_V = "bessell_v"
# Largest error of a colour, mag, and passes.
_TOLERANCE = 1e-4, 100


@dataclass(frozen=True, slots=True, eq=False)
class Models:
    """bolometric_h (AB) [teff, log_g, metallicity] mag, colors [.., 8] m_band - m_V (AB) of BANDS."""

    bolometric_h: Float
    colors: Float


@dataclass(frozen=True, slots=True)
class Mixture:
    """sed int64[PARTS, n] indices in the stellar library, frac float64[PARTS, n] shares of f_lambda at 5500 A."""

    sed: Int
    frac: Float


@lru_cache(maxsize=1)
def models() -> Models:
    """The table."""
    with TABLE.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    shape = (TEFF.size, LOG_G.size, METALLICITY.size)
    colors = np.array([[float(row[band]) for band in BANDS] for row in rows])
    bolometric = np.array([float(row["bolometric_h"]) for row in rows])
    return Models(bolometric.reshape(shape), colors.reshape(*shape, len(BANDS)))


def names() -> tuple[str, ...]:
    """Teff, log g and [M/H] of each model, the last the fastest."""
    return tuple(f"{t:.0f} K {g:.1f} {z:+.1f}" for t in TEFF for g in LOG_G for z in METALLICITY)


@lru_cache(maxsize=1)
def model_share() -> Float:
    """[teff, log_g, metallicity] share of the models at their nodes; the rest is the dwarf of that temperature."""
    share = np.ones((TEFF.size, LOG_G.size, METALLICITY.size))
    for k, value in enumerate(_HOT_SHARES):
        share[-1 - k] *= value
    for k, value in enumerate(_COOL_SHARES):
        share[k, _DWARF_GRAVITY] *= value
    return share


def spectra(dwarfs: Float, types: StellarTypes) -> Float:
    """f_lambda of each model on the grid of passbands.grid(), float64[n, 23401], normalised.

    dwarfs : float64[m, 23401] normalised spectra of the types
    Error  : colours within 1e-4 mag of the table's where nothing of the dwarfs is mixed in
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
    """Spectra of dwarfs at the models' temperatures, [n, m], of those of the types, [k, m], linear in ln Teff."""
    neighbours, weight = _neighbour_dwarfs(types, TEFF)
    interpolated = (1.0 - weight)[:, None] * dwarfs[neighbours[0]] + weight[:, None] * dwarfs[neighbours[1]]
    return np.repeat(interpolated, LOG_G.size * METALLICITY.size, axis=0)


def nearest_dwarfs(types: StellarTypes) -> Int:
    """Index of the hotter of the two dwarfs that stand beside each model."""
    return np.repeat(_neighbour_dwarfs(types, TEFF)[0][0], LOG_G.size * METALLICITY.size)


def mixture(types: StellarTypes, first: int, teff: Float, log_g: Float, metallicity: Float) -> Mixture:
    """What stars are made of, the largest share first.

    types : the dwarfs, which the library begins with;  first : index in it of the first model
    teff, log_g, metallicity : float64[n] K, cm s-2, [M/H]
    """
    n = teff.size
    sed, frac = np.zeros((MIXTURE_SIZE, n), np.int64), np.zeros((MIXTURE_SIZE, n))
    t, g, z = (np.ascontiguousarray(values, float) for values in (teff, log_g, metallicity))
    _mix(t, g, z, np.log(TEFF), LOG_G, METALLICITY, np.log(types.teff), first, _GIANT, sed, frac)
    return Mixture(sed, frac)


def bolometric_h(types: StellarTypes, vega: float, teff: Float, log_g: Float, metallicity: Float) -> Float:
    """M_bol - M_H (Vega)[n].

    types : the dwarfs;  vega : AB magnitude of Vega in H
    teff, log_g, metallicity : float64[n] K, cm s-2, [M/H]
    """
    mixed = mixture(types, types.teff.size, teff, log_g, metallicity)
    of_models = model_share() * (models().bolometric_h + vega)
    dwarf = np.interp(-np.log(TEFF), -np.log(types.teff), types.bolometric_h)
    values = np.concatenate([types.bolometric_h, (of_models + (1.0 - model_share()) * dwarf[:, None, None]).ravel()])
    return np.asarray((mixed.frac * values[mixed.sed]).sum(0))


def v_minus_h(types: StellarTypes, vega: tuple[float, float]) -> Float:
    """V - H (Vega) of the dwarfs and of the models, float64[m]; vega : AB magnitudes of Vega in V and H.

    Error: 0.02 mag (the dwarfs' H at the models' temperatures)
    """
    of_models = -models().colors[..., BANDS.index("twomass_h")] - vega[0] + vega[1]
    dwarf = np.interp(-np.log(TEFF), -np.log(types.teff), types.v_minus_h)[:, None, None]
    share = model_share()
    light = share * 10.0 ** (0.4 * of_models) + (1.0 - share) * 10.0 ** (0.4 * dwarf)
    return np.concatenate([types.v_minus_h, 2.5 * np.log10(light).ravel()])


def _neighbour_dwarfs(types: StellarTypes, teff: Float) -> tuple[Int, Float]:
    """The two dwarfs about temperatures [2, n], and the second's share[n], linear in ln Teff."""
    ln_teff = np.log(types.teff)
    cooler = np.clip(np.searchsorted(-ln_teff, -np.log(teff)), 1, ln_teff.size - 1)
    weight = (ln_teff[cooler - 1] - np.log(teff)) / (ln_teff[cooler - 1] - ln_teff[cooler])
    return np.stack([cooler - 1, cooler]), np.clip(weight, 0.0, 1.0)


@exact_jit
def _mix(
    teff: Float, log_g: Float, metallicity: Float, ln_teff: Float, gravities: Float, metals: Float, dwarfs: Float,
    first: int, giant: float, sed: Int, frac: Float,
) -> None:  # fmt: skip
    """Fills sed, frac [PARTS, n]; ln_teff, gravities, metals are the nodes, dwarfs the ln Teff of those, falling.

    The six simplices of a cell share its diagonal: from corner to corner goes first the axis along which the star is
    farthest.  Ref: Kuhn 1960, IBM J. Res. Dev. 4, 518
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
            # The three axes by falling share of the way.
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
    """(node before, share of the way to the next), inside the nodes."""
    low = min(max(int(np.searchsorted(nodes, value, side="right")) - 1, 0), nodes.size - 2)
    return low, min(max((value - nodes[low]) / (nodes[low + 1] - nodes[low]), 0.0), 1.0)
