"""Simulated matter: the log-normal density and the linear velocities in one periodic box.

From a Gaussian random field g(x) follow, with the linear growth D (D = 1 at z = 0), the matter overdensity delta, the
number density of halos n_halo and the velocity v::

    1 + delta(x, z) = exp(D(z) g(x) - D(z)^2 var(g) / 2)
    n_halo(x, z) ~ exp(A g_R - A^2 var(g_R) / 2)                  g_R is g smoothed with length R
    v(x, z) = a H f D u(x)                                        u is made from the linear density at z = 0

R and the amplitude A depend on the halo bias times D; f is the growth rate.

Notes
-----
The log-normal field has the power of linear theory within 5 % at 0.02 < k < 0.2 h/Mpc (tests). There is no halo
exclusion. The structure of halos and matter below the cell size of 4 Mpc/h is in `fine_structure`.

References
----------
Coles & Jones 1991, MNRAS 248, 1
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cache, partial

import numpy as np
import numpy.typing as npt
import scipy

from lake_schema.arrays import Complex64, Float, Float32, Int
from lake_schema.errors import BadInput
from truesky.catalogue import parameters
from truesky.catalogue.matter import boltzmann, linear_theory
from truesky.cosmology import Cosmology
from truesky.numerics.cache import cached_arrays, content_key
from truesky.numerics.cache_labels import label_box, label_halo_bias
from truesky.numerics.code_fingerprints import code_key
from truesky.randomness.rng import stream

_FILE = "density_box.toml"
# Number of values of ln k at which the power spectrum P(k) is computed before it is interpolated to the modes of a box;
# the relative error is 1e-5.
_K_NODES = 2000
# Cells per side of the box in which the ratios of `linear_share` and the halo bias are computed. The results are used
# for boxes of every size; their error is 0.5 %.
_GAIN_CELLS = 96
# Number of amplitudes at which the halo bias is computed, for each smoothed field.
_BIAS_NODES = 10
# Largest number of threads of the Fourier transforms; more threads are not faster.
_MAX_WORKERS = 8


@dataclass(frozen=True, slots=True)
class BoxModel:
    """Parameters of the box of simulated matter, explained in density_box.toml, [box], and its cosmology."""

    cell: float
    smoothing: tuple[float, ...]
    bias_field: tuple[int, ...]
    bias_edges: tuple[float, ...]
    bias_band: tuple[float, ...]
    bias_most: float
    bias_hold: float
    growth_index: float
    gain_band: tuple[float, ...]
    cosmology: Cosmology

    def key_parts(self) -> list[float | str]:
        """Return the values that identify the model in the key of a cached result."""
        names = [field.name for field in fields(self) if field.name != "cosmology"]
        numbers = [float(value) for name in names for value in np.atleast_1d(getattr(self, name))]
        return [*numbers, self.cosmology.fingerprint(), boltzmann.camb_version(self.cosmology)]


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """Simulated matter in a periodic cube of n^3 cells.

    Attributes
    ----------
    model : BoxModel
        Parameters of the box.
    n : int
        Cells per side.
    seed : int
        Seed of the random numbers.
    smoothed : tuple of float32 array, shape (n, n, n)
        Gaussian field g, smoothed with each length in `model.smoothing`; the first one is not smoothed.
    variance : float array, shape (number of smoothed fields,)
        Variance of each smoothed field.
    velocity : tuple of float32 array, shape (n, n, n)
        Components u_x, u_y and u_z in Mpc/h; the velocity in km/s is velocity_factor(z) times u.
    """

    model: BoxModel
    n: int
    seed: int
    smoothed: tuple[Float32, ...]
    variance: Float
    velocity: tuple[Float32, ...]

    @property
    def length(self) -> float:
        """Return the side of the cube, Mpc/h."""
        return self.n * self.model.cell


def box_model(cosmology: Cosmology) -> BoxModel:
    """Return the built-in parameters of the box of simulated matter, for a cosmology."""
    return BoxModel(**parameters.section(_FILE, "box"), cosmology=cosmology)


def load(seed: int, n: int, cosmology: Cosmology) -> Box:
    """Return the box of simulated matter for a seed with n cells per side, from the disc cache or made now.

    Parameters
    ----------
    seed : int
        Seed of the random numbers.
    n : int
        Number of cells per side.
    cosmology : Cosmology
        Parameters of the universe.

    Returns
    -------
    Box
        The box. Making it takes 6 s and 0.6 GB of memory for n = 256, because the fields are made and stored one at a
        time.

    Raises
    ------
    BadInput
        If n is not an even number of at least 2.
    """
    if n < 2 or n % 2:
        raise BadInput(f"a box must have an even number of cells per side, got {n}")
    model = box_model(cosmology)
    key = content_key(code_key(__name__), seed, n, *model.key_parts())
    cached = partial(_cached_field, key)
    # Transforms that several fields share are made once, and only if one of these fields is not in the disc cache.
    modes = cache(lambda: scipy.fft.rfftn(g))
    linear_modes = cache(lambda: _linear_modes(model, g))
    with scipy.fft.set_workers(min(os.cpu_count() or 1, _MAX_WORKERS)):
        g = cached("box_g", lambda: _gaussian(model, seed, n))
        smooth = [
            cached(f"box_g{i}", partial(_smooth, modes, model.cell, radius)) if radius else g
            for i, radius in enumerate(model.smoothing)
        ]
        modes.cache_clear()
        velocity = tuple(
            cached(f"box_u{axis}", partial(_displacement, linear_modes, model.cell, axis)) for axis in range(3)
        )
    label = label_box("box", cosmology.fingerprint(), seed, n)
    variance = cached("box_variance", lambda: np.array([field.var(dtype=float) for field in smooth]), label)
    return Box(model, n, seed, tuple(smooth), np.asarray(variance, float), velocity)


def tides(box: Box) -> tuple[Float32, ...]:
    """Return the traceless tidal field of the linear density at z = 0, from the disc cache or made now.

    The components are xx, yy, xy, xz and yz, float32, shape (n, n, n) each; zz is -xx - yy. Making them takes 4 s for
    n = 256. They are::

        T_ij = (d_i d_j / nabla^2 - delta_ij / 3) delta
    """
    cosmology = box.model.cosmology.fingerprint()
    version = boltzmann.camb_version(box.model.cosmology)
    key = content_key(code_key(__name__), box.seed, box.n, box.model.cell, cosmology, version)
    linear_modes, tide_fields = cache(lambda: _linear_modes(box.model, box.smoothed[0])), []
    label = label_box("tides", cosmology, box.seed, box.n)
    with scipy.fft.set_workers(min(os.cpu_count() or 1, _MAX_WORKERS)):
        for name, axis_1, axis_2 in (("xx", 0, 0), ("yy", 1, 1), ("xy", 0, 1), ("xz", 0, 2), ("yz", 1, 2)):
            make_tide = partial(_tide, linear_modes, box.model.cell, axis_1, axis_2)
            tide_fields.append(_cached_field(key, f"box_t{name}", make_tide, label))
    return tuple(tide_fields)


def velocity_factor(model: BoxModel, z: npt.ArrayLike) -> Float:
    """Return a H f D at each redshift in km/s per Mpc/h: the factor from `Box.velocity` to velocities in km/s.

    a is the scale factor, H the Hubble rate, f the growth rate and D the linear growth.
    """
    cosmology = model.cosmology
    rate = 100.0 * cosmology.expansion_rate(z) / (1.0 + np.asarray(z, float))
    return np.asarray(rate * cosmology.growth_rate(z, model.growth_index) * cosmology.growth(z))


def overdensity(box: Box, index: Int, growths: npt.ArrayLike) -> Float:
    """Return the matter overdensity in cells of the box.

    Parameters
    ----------
    box : Box
        Periodic box of simulated matter.
    index : int array, shape (n,)
        Flat index of the cells in arrays of shape (n, n, n).
    growths : float array, shape (n,)
        Linear growth D for each cell, 1 at z = 0.

    Returns
    -------
    float array, shape (n,)
        Overdensity delta.
    """
    d = np.asarray(growths, float)
    return np.asarray(np.expm1(d * box.smoothed[0].ravel()[index] - 0.5 * d**2 * box.variance[0]))


def matter_gain(model: BoxModel, growths: Float) -> Float:
    """Return the factor that gives the overdensity the power of linear theory, for each linear growth D.

    The factor is 1 at D = 1 (z = 0). The log-normal field has the correlation function (1 + xi)^(D^2) - 1, which is
    smaller than D^2 xi at large xi. Without the factor, 10 % of the power is missing at z = 1.
    """
    low, high = model.gain_band
    _, share = linear_share(model, growths, np.array([low, high]))
    return np.asarray(1.0 / np.sqrt(share[:, 0]))


def biased_field(model: BoxModel, x: Float) -> tuple[Int, Float]:
    """Return the index of the smoothed field that halos with x = bias times growth follow, and the amplitude A.

    `x` may have any shape, and both results have the same shape.

    Notes
    -----
    Halos that are drawn with a density ~ exp(A g_R), where g_R is the smoothed field, have the power spectrum
    x^2 P_linear(z = 0) in the range of k that `bias_band` of `model` gives (h/Mpc). A = x would be wrong by up to a
    factor of 1.5. The bias is accurate within 10 % at 0.02 < k < 0.25 h/Mpc for 0.7 < x < 6 (tests).
    """
    key, label = content_key(code_key(__name__), *model.key_parts()), label_halo_bias(model.cosmology.fingerprint())
    table = cached_arrays("halo_bias", key, lambda: _bias_table(model), label)
    place = np.searchsorted(np.array(model.bias_edges), x)
    amplitude = np.empty(x.shape)
    for i in range(len(model.bias_field)):
        selected = place == i
        amplitude[selected] = np.interp(x[selected], table["bias"][i], table["amplitude"][i])
    return np.array(model.bias_field)[place], amplitude


def linear_share(model: BoxModel, growths: Float, edges: Float) -> tuple[Float, Float]:
    """Return the power spectrum of the log-normal overdensity relative to linear theory.

    Parameters
    ----------
    model : BoxModel
        Parameters of the box.
    growths : float array, shape (n,)
        Linear growth D, 1 at z = 0.
    edges : float array, shape (bins + 1,)
        Edges of the bins of k, h/Mpc.

    Returns
    -------
    k : float array, shape (bins,)
        Mean k of the modes of each bin, h/Mpc.
    ratio : float array, shape (n, bins)
        Power of the overdensity / (D^2 times the linear power at z = 0).
    """
    n, cell = _GAIN_CELLS, model.cell
    power = _power_on_modes(model, n)
    k = np.sqrt(_k_squared(n, cell))
    place = np.digitize(k.ravel(), edges)

    def bin_modes(values: Float32) -> Float:
        return np.asarray(np.bincount(place, values.ravel().astype(float), edges.size + 1)[1:-1], float)

    linear = bin_modes(power)
    log_correlation = np.log1p(scipy.fft.irfftn(power, (n, n, n)) / np.float32(cell**3))
    powers = [bin_modes(scipy.fft.rfftn(np.expm1(np.float32(d**2) * log_correlation)).real) * cell**3 for d in growths]
    return bin_modes(k) / bin_modes(np.ones_like(k)), np.array(powers) / (growths[:, None] ** 2 * linear)


def linear_power(cosmology: Cosmology, k: npt.ArrayLike) -> Float:
    """Return the linear power P(k) of cold matter at z = 0 in (Mpc/h)^3, for k in h/Mpc."""
    return linear_theory.power(cosmology, np.asarray(k, float))


def _bias_table(model: BoxModel) -> dict[str, Float]:
    """Return the arrays "amplitude" and "bias", shape (smoothed fields, m) each.

    Halos with a density ~ exp(A g_R), with the amplitude A and the smoothed Gaussian field g_R, have the bias in "bias"
    relative to matter at z = 0. It includes that a halo has a random position within its voxel (small piece of volume),
    which holds on average over the structure below the cells of the box.
    """
    n, cell = _GAIN_CELLS, model.cell
    power, k_squared = _power_on_modes(model, n), _k_squared(n, cell)
    band = (k_squared > model.bias_band[0] ** 2) & (k_squared < model.bias_band[1] ** 2)
    # Give each interval of ln k the same weight, so that the many modes on small scales do not dominate.
    weight = k_squared[band].astype(float) ** -1.5 / power[band]
    linear_sum, damped_weight = np.sum(weight * power[band]), weight * np.exp(-(model.bias_hold**2) * k_squared[band])
    log_power, edge = _log_power(model, n), (0.0, *model.bias_edges, model.bias_most)
    amplitude, bias = np.empty((2, len(model.bias_field), _BIAS_NODES))
    for i, field in enumerate(model.bias_field):
        radius = model.smoothing[field]
        smooth = log_power * np.exp(np.float32(-radius * abs(radius)) * k_squared)
        correlation = scipy.fft.irfftn(smooth, (n, n, n)) / np.float32(cell**3)
        amplitude[i] = np.linspace(max(0.4 * edge[i], 0.01), 1.2 * edge[i + 1], _BIAS_NODES)
        for j, times in enumerate(amplitude[i]):
            halo_power = scipy.fft.rfftn(np.expm1(np.float32(times**2) * correlation)).real[band] * cell**3
            bias[i, j] = np.sqrt(np.sum(damped_weight * halo_power) / linear_sum)
    return {"bias": bias, "amplitude": amplitude}


def _cached_field(key: str, name: str, make: Callable[[], npt.NDArray[np.generic]], label: str = "") -> Float32:
    return np.asarray(cached_arrays(name, key, lambda: {"field": make()}, label)["field"])


def _gaussian(model: BoxModel, seed: int, n: int) -> Float32:
    """Return the Gaussian field g, float32 (n, n, n), for which exp(g) has the linear power spectrum at z = 0."""
    noise = np.empty((n, n, n), np.float32)
    for x in range(n):
        # Draw one plane of cells at a time, so that no second array of n^3 numbers is needed.
        noise[x] = stream(seed, "box", x).standard_normal((n, n), np.float32)
    modes = scipy.fft.rfftn(noise, overwrite_x=True)
    del noise
    modes *= np.sqrt(_log_power(model, n) / np.float32(model.cell**3))
    return _to_real(modes, n)


def _log_power(model: BoxModel, n: int) -> Float32:
    """Return the power of the Gaussian field g on the Fourier modes of the box, (Mpc/h)^3.

    It is the Fourier transform of the correlation function ln(1 + xi), where xi is the linear one. Negative values are
    set to 0.
    """
    power, cell = _power_on_modes(model, n), model.cell
    correlation = scipy.fft.irfftn(power, (n, n, n), overwrite_x=True) / np.float32(cell**3)
    transformed = scipy.fft.rfftn(np.log1p(correlation), overwrite_x=True).real * np.float32(cell**3)
    transformed[0, 0, 0] = 0.0
    return np.asarray(np.maximum(transformed, np.float32(0.0)))


def _power_on_modes(model: BoxModel, n: int) -> Float32:
    """Return the linear power at z = 0 on the Fourier modes of the box, (Mpc/h)^3; 0 at k = 0."""
    cell = model.cell
    k = np.sqrt(_k_squared(n, cell))
    largest = np.sqrt(3.0) * np.pi / cell
    ln_k = np.linspace(np.log(np.pi / (n * cell)), np.log(1.01 * largest), _K_NODES)
    ln_power = np.log(linear_power(model.cosmology, np.exp(ln_k)))
    np.log(np.maximum(k, np.exp(ln_k[0]), out=k), out=k)
    power = np.exp(np.interp(k, ln_k, ln_power).astype(np.float32))
    power[0, 0, 0] = 0.0
    return np.asarray(power)


def _smooth(modes: Callable[[], Complex64], cell: float, radius: float) -> Float32:
    """Return the field with the Fourier modes `modes()`, smoothed with a Gaussian; see `BoxModel.smoothing`."""
    n = modes().shape[0]
    return _to_real(modes() * np.exp(np.float32(-0.5 * radius * abs(radius)) * _k_squared(n, cell)), n)


def _displacement(linear_modes: Callable[[], tuple[Complex64, Float32]], cell: float, axis: int) -> Float32:
    """Return the component of u (see `Box.velocity`) along one axis in Mpc/h: i k / k^2 times the linear density."""
    modes, k_squared = linear_modes()
    n = modes.shape[0]
    return _to_real(modes * (1j * _k_signed(n, cell, axis) / k_squared).astype(np.complex64), n)


def _tide(linear_modes: Callable[[], tuple[Complex64, Float32]], cell: float, axis_1: int, axis_2: int) -> Float32:
    """Return one component of the tidal field: k_i k_j / k^2 times the linear density, minus density / 3 if i = j."""
    modes, k_squared = linear_modes()
    n = modes.shape[0]
    product = _k_signed(n, cell, axis_1) * _k_signed(n, cell, axis_2) / k_squared
    return _to_real(modes * (product - (axis_1 == axis_2) / 3.0).astype(np.float32), n)


def _linear_modes(model: BoxModel, g: Float32) -> tuple[Complex64, Float32]:
    """Return the Fourier modes of the linear density at z = 0, and k^2 of the modes.

    The modes have the phases of g. k^2 is set to 1 at k = 0, so that a division is possible.
    """
    n, cell = g.shape[0], model.cell
    modes = scipy.fft.rfftn(g)
    log_power = _log_power(model, n)
    empty = np.zeros(modes.shape, np.float32)
    modes *= np.sqrt(np.divide(_power_on_modes(model, n), log_power, out=empty, where=log_power > 0.0))
    k_squared = _k_squared(n, cell)
    k_squared[0, 0, 0] = 1.0
    return modes, k_squared


def _k_signed(n: int, cell: float, axis: int) -> Float:
    """Return the wave numbers (h/Mpc) along one axis, with 0 at the Nyquist frequency, where the sign is undefined."""
    k = _k_axes(n, cell)[axis].copy()
    k[np.abs(k) > 0.999 * np.pi / cell] = 0.0
    return k


def _k_axes(n: int, cell: float) -> tuple[Float, Float, Float]:
    k = 2.0 * np.pi * scipy.fft.fftfreq(n, cell)
    half = 2.0 * np.pi * scipy.fft.rfftfreq(n, cell)
    return k[:, None, None], k[None, :, None], half[None, None, :]


def _k_squared(n: int, cell: float) -> Float32:
    x, y, z = _k_axes(n, cell)
    return np.asarray((x**2 + y**2).astype(np.float32) + (z**2).astype(np.float32))


def _to_real(modes: Complex64, n: int) -> Float32:
    return np.asarray(scipy.fft.irfftn(modes, (n, n, n), overwrite_x=True), np.float32)
