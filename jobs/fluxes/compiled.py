"""The inner loops of the flux grid, compiled by numba; the machine code lies in the project's cache.

place         where galaxies lie between the nodes in redshift
products      their polynomials in E(B-V) and A_V
continuum     what the two components of galaxies give in one band
line_centres  where lines are seen, and what the Milky Way leaves of them
line_sums     what lines give through one band

Plain loops over rows: no source depends on its neighbours, not in the last bit.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt

from jobs import cache

# Compiled once a machine, not once a process. numba reads this when it is imported.
os.environ.setdefault("NUMBA_CACHE_DIR", str(cache.cache_dir() / "numba"))

import numba

Float = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Int = npt.NDArray[np.int64]

_Loop = TypeVar("_Loop", bound=Callable[..., None])


def _jit(loop: _Loop) -> _Loop:
    # Sums may be taken in any order, which makes them twice as fast; NaN and infinity keep their meaning.
    compiled: Any = numba.njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})(loop)
    return cast(_Loop, compiled)


@_jit
def place(log_z: Float, log_first: float, step: float, z_count: int, row: Int, z_weights: Float32) -> None:
    """Fills row, int64[n], and z_weights, float32[n, 4]: Lagrange's, of four nodes from `row`; log_z = ln(1 + z)."""
    for i in range(len(log_z)):
        position = (log_z[i] - log_first) / step
        # One-sided at the ends.
        first = min(max(int(np.floor(position)) - 1, 0), z_count - 4)
        t = position - first - 1.0
        row[i] = first
        z_weights[i, 0] = -t * (t - 1.0) * (t - 2.0) / 6.0
        z_weights[i, 1] = (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0
        z_weights[i, 2] = -(t + 1.0) * t * (t - 2.0) / 2.0
        z_weights[i, 3] = (t + 1.0) * t * (t - 1.0) / 6.0


@_jit
def products(
    law: Int, ebv: Float, a_v: Float, ebv_last: float, a_v_last: float, n_ebv: int, n_av: int, basis: Float32
) -> None:
    """Fills basis, float32[2, n, n_ebv * n_av]: products of Chebyshev polynomials in E(B-V), [2, n], and A_V, [n]."""
    in_ebv, in_av = np.empty(n_ebv), np.empty(n_av)
    for i in range(len(a_v)):
        _chebyshev(2.0 * a_v[i] / a_v_last - 1.0, in_av)
        for k in range(2):
            _chebyshev(2.0 * (ebv[k, i] if law[k, i] > 0 else 0.0) / ebv_last - 1.0, in_ebv)
            for p in range(n_ebv):
                for q in range(n_av):
                    basis[k, i, p * n_av + q] = in_ebv[p] * in_av[q]


@_jit
def _chebyshev(x: float, out: Float) -> None:
    before, now = x, 1.0
    for k in range(len(out)):
        out[k] = now
        before, now = now, 2.0 * x * now - before


@_jit
def continuum(
    table: Float32, row: Int, z_weights: Float32, sed: Int, law: Int, basis: Float32, frac: Float, out: Float
) -> None:
    """Fills out[i] = sum_k frac[k, i] exp(ln of the ratio of component k).

    table : float32[n_template, 4, n_z, n_coefficient], laws 1 .. 4; without a law E(B-V) is 0 in any of them
    """
    # Flat arrays and unsigned positions: nothing is looked up from the end.
    flat, n_law, n_z, count = table.ravel(), table.shape[1], table.shape[2], np.uint64(table.shape[3])
    polynomials, n = basis.ravel(), len(row)
    for i in range(n):
        total = 0.0
        w0, w1, w2, w3 = z_weights[i, 0], z_weights[i, 1], z_weights[i, 2], z_weights[i, 3]
        for k in range(2):
            if frac[k, i] == 0.0:
                continue
            node0 = np.uint64((sed[k, i] * n_law + max(law[k, i] - 1, 0)) * n_z + row[i]) * count
            node1, node2, node3 = node0 + count, node0 + count + count, node0 + count + count + count
            at = np.uint64(k * n + i) * count
            log_ratio = np.float32(0.0)
            for c in range(count):
                mixed = w0 * flat[node0 + c] + w1 * flat[node1 + c] + w2 * flat[node2 + c] + w3 * flat[node3 + c]
                log_ratio += mixed * polynomials[at + c]
            total += frac[k, i] * np.exp(np.float64(log_ratio))
        out[i] = total


@_jit
def line_centres(
    fluxes: Float, z_obs: Float, a_v: Float, vacuum: Float, ciddor: Float, curve: Float, first: float,
    centre: Float, flux: Float,
) -> None:  # fmt: skip
    """Fills centre, ln of the observed wavelength in A in a vacuum and in air, and flux, behind the Milky Way.

    ciddor : float64[2, 2] (strength, resonance) of the refractivity of air
    curve  : A(lambda) / A(V) in steps of 1 A from `first`; lines beyond it are in no band
    centre, flux : float64[2, n, n_line]
    """
    for i in range(len(z_obs)):
        for j in range(len(vacuum)):
            flux[0, i, j] = flux[1, i, j] = 0.0
            lam = vacuum[j] * (1.0 + z_obs[i])
            position = lam - first
            if fluxes[i, j] == 0.0 or position < 0.0 or position >= len(curve) - 1:
                continue
            square = (1e4 / lam) ** 2
            refractivity = ciddor[0, 0] / (ciddor[0, 1] - square) + ciddor[1, 0] / (ciddor[1, 1] - square)
            shift = np.log1p(1e-8 * refractivity)
            centre[0, i, j] = np.log(lam)
            centre[1, i, j] = centre[0, i, j] - shift
            low = int(position)
            slope = curve[low + 1] - curve[low]
            depth = 0.4 * np.log(10.0) * a_v[i]
            flux[0, i, j] = fluxes[i, j] * np.exp(-depth * (curve[low] + (position - low) * slope))
            # The extinction at the wavelength in air, to first order in a shift of 3e-4.
            flux[1, i, j] = flux[0, i, j] * (1.0 + depth * slope * lam * shift)


@_jit
def line_sums(
    centre: Float, flux: Float, width: Int, share: Float, tables: Float32, place: Int, first: Float, step: float,
    cells: Int, members: Int, cell_first: float, cell_step: float, out: Float,
) -> None:  # fmt: skip
    """Adds to out[b, i] the flux of each line times what band b makes of a line of that width there.

    width, share : [n] node of the width below the galaxy's, and how far towards the next, 0 .. 1
    tables       : float32[sum of n_lambda, n_width] of all bands, uniform in ln(lambda) by `step`
    place        : int64[n_band, 3] first row and number of rows of a band in `tables`, and its medium, 1 for air
    first        : float64[n_band] ln(lambda) of a band's first row
    cells        : int64[n_cell + 1]: members[cells[c] : cells[c + 1]] are the bands that see wavelength cell c
    """
    per_row, per_cell = 1.0 / step, 1.0 / cell_step
    # One flat array and unsigned positions: nothing is looked up from the end.
    flat, widths = tables.ravel(), np.uint64(tables.shape[1])
    for i in range(flux.shape[1]):
        w, s = np.uint64(width[i]), share[i]
        for j in range(flux.shape[2]):
            if flux[0, i, j] == 0.0:
                continue
            cell = int((centre[0, i, j] - cell_first) * per_cell)
            for m in range(cells[cell], cells[cell + 1]):
                b = members[m]
                medium = place[b, 2]
                position = (centre[medium, i, j] - first[b]) * per_row
                if position < 0.0 or position >= place[b, 1] - 1:
                    continue
                low = int(position)
                part = position - low
                blue = np.uint64(place[b, 0] + low) * widths + w
                red = blue + widths
                narrow = flat[blue] + part * (flat[red] - flat[blue])
                wide = flat[blue + np.uint64(1)] + part * (flat[red + np.uint64(1)] - flat[blue + np.uint64(1)])
                out[b, i] += flux[medium, i, j] * (narrow + s * (wide - narrow))
