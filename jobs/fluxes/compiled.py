"""The inner loops of the flux grid, compiled by numba; its machine code lies in the project's cache.

continuum     sum over the two components of what the grid gives in one band
line_centres  where lines are seen and what the Milky Way leaves of them
line_sums     what lines give through one band

Plain loops over rows, each row by itself: a source does not depend on its neighbours, to the bit.
"""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

from jobs import cache

Float = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Int = npt.NDArray[np.int64]

# Compiled once a machine, not once a process: numba asks for the folder when the functions below are defined.
if not numba.config.CACHE_DIR:
    numba.config.CACHE_DIR = str(cache.cache_dir() / "numba")


@numba.njit(cache=True, error_model="numpy")
def continuum(
    table: Float32, row: Int, z_weights: Float32, sed: Int, law: Int, basis: Float32, frac: Float, out: Float
) -> None:
    """out[i] = sum_k frac[k, i] exp(ln ratio of component k).

    table     : float32[n_template, n_law, n_z, n_coefficient];  row : int64[n] first of four nodes in z
    z_weights : float32[n, 4];  basis : float32[2, n, n_coefficient];  out : float64[n]
    """
    count = table.shape[3]
    mixed = np.empty(count, np.float32)
    for i in range(len(row)):
        total = 0.0
        for k in range(2):
            if frac[k, i] == 0.0:
                continue
            nodes = table[sed[k, i], law[k, i], row[i] : row[i] + 4]
            w0, w1, w2, w3 = z_weights[i, 0], z_weights[i, 1], z_weights[i, 2], z_weights[i, 3]
            at = basis[k, i]
            for c in range(count):
                mixed[c] = (w0 * nodes[0, c] + w1 * nodes[1, c] + w2 * nodes[2, c] + w3 * nodes[3, c]) * at[c]
            log_ratio = 0.0
            for c in range(count):
                log_ratio += mixed[c]
            total += frac[k, i] * np.exp(log_ratio)
        out[i] = total


@numba.njit(cache=True, error_model="numpy")
def line_centres(
    fluxes: Float, z_obs: Float, a_v: Float, vacuum: Float, ciddor: Float, curve: Float, first: float,
    centre: Float, flux: Float,
) -> None:  # fmt: skip
    """Logarithms of the observed wavelengths, and fluxes behind the Milky Way: fills centre, flux, float64[n, n_line].

    ciddor : float64[2, 2] strengths and resonances of the refractivity of air; strengths 0 in vacuum
    curve  : float64[n_lambda] A(lambda) / A(V) from `first` in steps of 1 A
    """
    for i in range(len(z_obs)):
        for j in range(len(vacuum)):
            flux[i, j] = 0.0
            if fluxes[i, j] == 0.0:
                continue
            lam = vacuum[j] * (1.0 + z_obs[i])
            square = (1e4 / lam) ** 2
            lam /= 1.0 + 1e-8 * (ciddor[0, 0] / (ciddor[0, 1] - square) + ciddor[1, 0] / (ciddor[1, 1] - square))
            centre[i, j] = np.log(lam)
            position = lam - first
            if position < 0.0 or position >= len(curve) - 1:
                # Beyond every band.
                continue
            low = int(position)
            part = position - low
            k = curve[low] + part * (curve[low + 1] - curve[low])
            flux[i, j] = fluxes[i, j] * 10.0 ** (-0.4 * k * a_v[i])


@numba.njit(cache=True, error_model="numpy")
def line_sums(
    centre: Float, flux: Float, smooth: Int, share: Float, table: Float32, first: float, step: float, out: Float
) -> None:
    """out[i] = sum over lines of flux times the response seen by a line of that width; table as LineGrid.response.

    smooth, share : int64[n], float64[n] node below a galaxy's width, and how far to the next (0 .. 1)
    """
    count = table.shape[0]
    for i in range(centre.shape[0]):
        total = 0.0
        low_width, part_width = smooth[i], share[i]
        for j in range(centre.shape[1]):
            if flux[i, j] == 0.0:
                continue
            position = (centre[i, j] - first) / step
            if position < 0.0 or position >= count - 1:
                continue
            low = int(position)
            part = position - low
            narrow = table[low, low_width] + part * (table[low + 1, low_width] - table[low, low_width])
            wide = table[low, low_width + 1] + part * (table[low + 1, low_width + 1] - table[low, low_width + 1])
            total += flux[i, j] * (narrow + part_width * (wide - narrow))
        out[i] = total
