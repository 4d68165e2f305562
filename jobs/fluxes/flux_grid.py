"""Band fluxes of galaxies and stars from tables: a few hundred times faster than integrating.

Setting             how fine a table is: three numbers
galaxies, stars     f_nu of checked rows, float64[n, n_band] microjansky
inside              which galaxies the tables cover
prepare             make the tables that are not in the cache

A band's flux is linear in the two components and additive in the lines. Its logarithm, of one template behind one law, is
smooth in E(B-V) and in the Milky Way's A_V, being a cumulant generating function of the extinction over the band: a
polynomial of low order. In redshift it is interpolated by cubics, uniform in ln(1 + z).
The tables hold ln(f_nu in the band at z / f_nu in the reference band at rest) of each template, both behind its dust. The
reference band's own table brings the sum to the apparent reference magnitude.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from jobs import cache
from jobs.fluxes import extinction, passbands
from jobs.fluxes.calibration import continuum_scale
from jobs.fluxes.continuum import REFERENCE_BAND, Mix, dust_of, rest_flux
from jobs.fluxes.passbands import Passband
from jobs.fluxes.sources import Galaxies
from jobs.fluxes.templates import Library

Float = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Int = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

# What the tables of galaxies cover; rows beyond are integrated.
Z_FIRST, Z_LAST = -0.021, 3.05
EBV_LAST, A_V_LAST = 0.6, 1.55
# Nodes of a cubic.
_NODES = 4
# Rows that are interpolated together: their weights stay in the processor's cache.
_CHUNK = 2048


@dataclass(frozen=True, slots=True)
class Setting:
    """step in ln(1 + z); n_ebv, n_av: coefficients in E(B-V) and in A_V."""

    step: float
    n_ebv: int
    n_av: int

    @property
    def z_count(self) -> int:
        return int(np.ceil((np.log1p(Z_LAST) - np.log1p(Z_FIRST)) / self.step)) + 1


@dataclass(frozen=True, slots=True)
class Weights:
    """What n galaxies have to do with every table of one setting.

    row   : int64[n] first of four nodes;  z : float32[n, 4]
    basis : float32[2, n, n_ebv * n_av] products of Chebyshev polynomials
    """

    row: Int
    z: Float32
    basis: Float32


def inside(rows: Galaxies) -> Bool:
    """Which galaxies the tables cover, bool[n]; a component without flux or without dust may have any E(B-V)."""
    mix = rows.mix
    dusty = (mix.ebv > EBV_LAST) & (mix.law > 0) & (mix.frac > 0.0)
    near = (mix.z_obs >= Z_FIRST) & (mix.z_obs <= Z_LAST)
    return np.asarray(near & ~dusty.any(0) & (rows.a_v <= A_V_LAST))


def continuum(mix: Mix, a_v: Float, tables: Sequence[tuple[Setting, Float32]]) -> Float:
    """f_nu relative to the reference band at rest, float64[n, n_table]."""
    from jobs.fluxes import compiled

    out = np.empty((len(tables), len(mix)))
    order = np.argsort(mix.z_obs, kind="stable")
    for start in range(0, len(mix), _CHUNK):
        part = order[start : start + _CHUNK]
        block, dust = mix.rows(part), a_v[part]
        weights = {setting: _weights(setting, block, dust) for setting in {setting for setting, _ in tables}}
        values = np.empty(len(part))
        for k, (setting, table) in enumerate(tables):
            w = weights[setting]
            compiled.continuum(table, w.row, w.z, block.sed, block.law, w.basis, block.frac, values)
            out[k, part] = values
    return out.T


def galaxy_table(band: Passband, library: Library, setting: Setting) -> Float32:
    """float32[n_template, 5, n_z, n_ebv * n_av] coefficients of the logarithm, from the cache or made in a second."""
    reference = passbands.load(REFERENCE_BAND)
    key = cache.content_key(
        Path(__file__).read_bytes(), library_key(library), setting.step, setting.n_ebv, setting.n_av, band.wavelength,
        band.response, reference.wavelength, reference.response,
    )  # fmt: skip
    arrays = cache.cached_arrays(
        f"flux_grid_{band.name}", key, lambda: {"coefficients": _tabulate(library, band, reference, setting)}
    )
    return arrays["coefficients"]


def library_key(library: Library) -> str:
    return cache.content_key(library.wavelength, np.asarray(library.flux), extinction.laws(library.wavelength[::100]))


def _tabulate(library: Library, band: Passband, reference: Passband, setting: Setting) -> Float32:
    """By the transposed problem: at each node the weights of the band are shifted, once for all spectra."""
    dust = dust_of(library)
    ebv, a_v = _nodes(setting.n_ebv, EBV_LAST), _nodes(setting.n_av, A_V_LAST)
    # The law without dust needs one node.
    law, node = np.array([(0, 0), *((law, k) for law in range(1, extinction.LAW_COUNT) for k in range(setting.n_ebv))]).T
    behind = np.where(law > 0, ebv[node], 0.0)
    sed, law, behind = (np.repeat(np.arange(len(library)), len(law)), *(np.tile(x, len(library)) for x in (law, behind)))
    at_rest = rest_flux(sed, law, behind, reference, library, dust)
    first = int(band.wavelength[0] / (1.0 + Z_LAST) - library.wavelength[0]) - int(1 / setting.step > 0)
    first = max(int(band.wavelength[0] / np.exp(_z_node(setting, setting.z_count - 1)) - library.wavelength[0]) - 1, 0)
    last = int(band.wavelength[-1] / np.exp(_z_node(setting, 0)) - library.wavelength[0]) + 3
    stretch = dust[:, first:last]
    spectra = library.flux[sed, first:last]
    spectra *= extinction.transmitted(stretch[law], behind.astype(np.float32)[:, None])
    weights = passbands.weights(band)
    total = float(weights.sum())
    dimmed = weights / total * extinction.transmitted(extinction.milky_way(band.wavelength), a_v[:, None])
    observed = np.empty((setting.z_count, len(sed), setting.n_av))
    for i in range(setting.z_count):
        stretching = np.exp(_z_node(setting, i))
        low, moved = _moved(band.wavelength / stretching - library.wavelength[first], dimmed / stretching)
        observed[i] = spectra[:, low : low + moved.shape[1]] @ moved.T.astype(np.float32)
    # A template without flux that far in the ultraviolet: as faint as single precision goes.
    log_ratio = np.log(np.maximum(observed, np.finfo(np.float32).tiny) * (total / at_rest)[:, None])
    return _coefficients(log_ratio.reshape(setting.z_count, len(library), -1, setting.n_av), setting)


def _coefficients(log_ratio: Float, setting: Setting) -> Float32:
    """Values at the nodes [n_z, n_template, 1 + 4 n_ebv, n_av] -> Chebyshev coefficients, as the tables hold them."""
    shape = (log_ratio.shape[1], extinction.LAW_COUNT, log_ratio.shape[0], setting.n_ebv, setting.n_av)
    out = np.zeros(shape, np.float32)
    in_av = np.einsum("ztem,qm->tezq", log_ratio, _to_coefficients(setting.n_av))
    out[:, 0, :, 0] = in_av[:, 0]
    dusty = in_av[:, 1:].reshape(shape[0], extinction.LAW_COUNT - 1, setting.n_ebv, shape[2], setting.n_av)
    out[:, 1:] = np.einsum("tlezq,pe->tlzpq", dusty, _to_coefficients(setting.n_ebv))
    return out.reshape(*shape[:3], -1)


def _moved(position: Float, weights: Float) -> tuple[int, Float]:
    """Weights [m, n] of linear interpolation at fractional positions [n], summed on the whole ones: (first, [m, w])."""
    index = np.floor(position).astype(np.int64)
    part = position - index
    low, width = int(index[0]), int(index[-1] - index[0]) + 2
    rows = [
        np.bincount(index - low, w * (1.0 - part), width) + np.bincount(index - low + 1, w * part, width)
        for w in weights
    ]
    return low, np.stack(rows)


def _weights(setting: Setting, mix: Mix, a_v: Float) -> Weights:
    position = (np.log1p(mix.z_obs) - _z_node(setting, 0)) / setting.step
    row = np.clip(np.floor(position).astype(np.int64) - 1, 0, setting.z_count - _NODES)
    t = position - row - 1.0
    z = np.stack(
        [
            -t * (t - 1.0) * (t - 2.0) / 6.0,
            (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0,
            -(t + 1.0) * t * (t - 2.0) / 2.0,
            (t + 1.0) * t * (t - 1.0) / 6.0,
        ],
        1,
    )
    in_ebv = _chebyshev(np.where(mix.law > 0, np.minimum(mix.ebv, EBV_LAST), 0.0), EBV_LAST, setting.n_ebv)
    in_av = _chebyshev(a_v, A_V_LAST, setting.n_av)
    # T_p = +-1 at no dust, and the coefficients of p > 0 are 0 without a law.
    basis = (in_ebv[..., :, None] * in_av[None, :, None, :]).reshape(2, len(mix), -1)
    return Weights(row, z.astype(np.float32), basis.astype(np.float32))


def _z_node(setting: Setting, number: int) -> float:
    """ln(1 + z) of a node."""
    return float(np.log1p(Z_FIRST)) + setting.step * number


def _nodes(count: int, last: float) -> Float:
    """Chebyshev's nodes in [0, last]."""
    return np.asarray(0.5 * last * (1.0 + np.cos(np.pi * (np.arange(count) + 0.5) / count)))


def _to_coefficients(count: int) -> Float:
    """Matrix from values at the nodes to coefficients."""
    return np.linalg.inv(np.polynomial.chebyshev.chebvander(2.0 * _nodes(count, 1.0) - 1.0, count - 1))


def _chebyshev(values: Float, last: float, count: int) -> Float:
    """Chebyshev polynomials T_0 .. T_(count - 1) on [0, last], float64[..., count]."""
    return np.asarray(np.polynomial.chebyshev.chebvander(2.0 * values / last - 1.0, count - 1))
