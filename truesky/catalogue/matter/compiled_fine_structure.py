"""Compiled loops of `fine_structure`: lattice noise, weights of voxels, and positions of halos in voxels.

The noise has a random number at each point of a cubic lattice, which is a hash of the lattice point. Between lattice
points it is interpolated linearly. Hashes are of 32-bit integers, so that the loop over positions uses vector
instructions of the CPU.

References
----------
Steele & Vigna 2022, Softw. Pract. Exp. 52, 372, and C. Wellons, "Prospecting for Hash Functions" (32-bit hash)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from truesky.numerics.compiling import exact_jit
from truesky.randomness.compiled_draws import child_key, uniform

# Lattice coordinates are shifted by this number to make them positive, because a conversion to int rounds towards 0.
_ORIGIN = 65536.0
# The number of a lattice point is the sum of the four bytes of its hash: mean and standard deviation of this sum.
BYTE_MEAN, BYTE_SCATTER = 510.0, float(np.sqrt(4.0 * (256.0**2 - 1.0) / 12.0))
_U1, _U8, _U15, _U16 = (np.uint32(bits) for bits in (1, 8, 15, 16))
_FACTOR_1, _FACTOR_2 = np.uint32(0x7FEB352D), np.uint32(0x846CA68B)
_EVEN_BYTES, _LOW_HALF = np.uint32(0x00FF00FF), np.uint32(0xFFFF)
# Numbers with which the random keys of a halo are derived from its place key: choice of the subvoxel, choice between
# candidates, and the first number for the candidates.
_SUBVOXEL, _CHOICE, _CANDIDATES = range(3)


@exact_jit
def mix_32(bits: Any) -> Any:
    """Return a hash of 32 bits, a uint32. Every result belongs to exactly one input."""
    # Numba computes with 64 bits; each step is cut to 32 bits, so that the compiler uses 32-bit instructions.
    bits = np.uint32(np.uint32(bits ^ np.uint32(bits >> _U16)) * _FACTOR_1)
    bits = np.uint32(np.uint32(bits ^ np.uint32(bits >> _U15)) * _FACTOR_2)
    return np.uint32(bits ^ np.uint32(bits >> _U16))


@exact_jit
def _sum_bytes(bits: Any) -> Any:
    pairs = np.uint32(np.uint32(bits & _EVEN_BYTES) + np.uint32(np.uint32(bits >> _U8) & _EVEN_BYTES))
    return np.float64(np.int32(np.uint32(np.uint32(pairs & _LOW_HALF) + np.uint32(pairs >> _U16))))


@exact_jit
def _along_row(row: Any, z_0: Any, z_1: Any, z: Any) -> Any:
    """Interpolate linearly between the lattice points z_0 and z_1 of a row, at the fraction z of the step."""
    return (1.0 - z) * _sum_bytes(mix_32(np.uint32(row ^ z_0))) + z * _sum_bytes(mix_32(np.uint32(row ^ z_1)))


@exact_jit
def add_octave(key_1: Any, key_2: Any, step: Any, scatter: Any, vector: Any, chi: Any, out: Any) -> None:
    """Add one octave of lattice noise at positions.

    Parameters
    ----------
    key_1, key_2 : uint32
        Random keys of the octave.
    step : float
        Lattice step, Mpc/h.
    scatter : float
        Standard deviation of the noise that is added; it is the same at every position.
    vector : float array, shape (3, n)
        Unit vectors from the observer to the positions.
    chi : float array, shape (n,)
        Comoving distances, Mpc/h; the distance divided by `step` must be below 65536.
    out : float array, shape (n,)
        The noise is added to these numbers.
    """
    scale, factor = 1.0 / step, scatter / BYTE_SCATTER
    for i in range(chi.size):
        distance = chi[i] * scale
        x, y = vector[0, i] * distance + _ORIGIN, vector[1, i] * distance + _ORIGIN
        z = vector[2, i] * distance + _ORIGIN
        x_int, y_int, z_int = np.int32(x), np.int32(y), np.int32(z)
        x, y, z = x - np.float64(x_int), y - np.float64(y_int), z - np.float64(z_int)
        y_0, z_0 = np.uint32(np.uint32(y_int) + key_2), np.uint32(z_int)
        y_1, z_1 = np.uint32(y_0 + _U1), np.uint32(z_0 + _U1)
        # Hash the three coordinates one after another, so that lattice points share the first hashes.
        plane_0 = mix_32(np.uint32(np.uint32(x_int) + key_1))
        plane_1 = mix_32(np.uint32(np.uint32(np.uint32(x_int) + _U1) + key_1))
        row_00, row_01 = mix_32(np.uint32(plane_0 ^ y_0)), mix_32(np.uint32(plane_0 ^ y_1))
        row_10, row_11 = mix_32(np.uint32(plane_1 ^ y_0)), mix_32(np.uint32(plane_1 ^ y_1))
        sum_00, sum_01 = _along_row(row_00, z_0, z_1, z), _along_row(row_01, z_0, z_1, z)
        sum_10, sum_11 = _along_row(row_10, z_0, z_1, z), _along_row(row_11, z_0, z_1, z)
        mean = (1.0 - x) * ((1.0 - y) * sum_00 + y * sum_01) + x * ((1.0 - y) * sum_10 + y * sum_11)
        # Interpolation decreases the variance between lattice points by this factor.
        variance = (1.0 - 2.0 * x * (1.0 - x)) * (1.0 - 2.0 * y * (1.0 - y)) * (1.0 - 2.0 * z * (1.0 - z))
        out[i] += factor * (mean - BYTE_MEAN) / np.sqrt(variance)


@exact_jit
def mean_weights(value: Any, first: Any, amplitude: Any, norm: Any, out: Any) -> None:
    """Fill `out` with the mean of exp(amplitude G) / norm over the subvoxels of each voxel.

    Parameters
    ----------
    value : float array, shape (p,)
        G of the subvoxels.
    first : int array, shape (v + 1,)
        First subvoxel of each voxel; the last value is p.
    amplitude, norm : float array, shape (fields,)
        Amplitude and norm of the halos that follow each smoothed field.
    out : float array, shape (v, fields)
        Output: the weights.
    """
    for v in range(first.size - 1):
        for f in range(amplitude.size):
            total = 0.0
            for p in range(first[v], first[v + 1]):
                total += np.exp(amplitude[f] * value[p])
            out[v, f] = total / (norm[f] * (first[v + 1] - first[v]))


@exact_jit
def fill_candidates(place: Any, voxel: Any, amplitude: Any, value: Any, first: Any, shift: Any, out: Any) -> None:
    """Choose the subvoxel of each halo by weight, and draw candidate positions in it.

    Parameters
    ----------
    place : uint64 array, shape (n,)
        Random key of the position of each halo.
    voxel : int array, shape (n,)
        Voxel of each halo.
    amplitude : float array, shape (n,)
        Amplitude B of each halo; the weight of a subvoxel is exp(B G).
    value, first : array
        Same as in `mean_weights`. A voxel has 8 subvoxels (near and far half of its four child cells) or 2 (near and
        far half).
    shift : int array, shape (n,)
        Number of bits of a position (HEALPix cell of order 29) inside the cell of the voxel.
    out : tuple of array
        Two arrays to fill, shape (candidates, n): position in the cell of the voxel (int64), and fraction of the volume
        of the voxel that is nearer (float64).
    """
    inside, nearer = out
    for i in range(place.size):
        begin, end = first[voxel[i]], first[voxel[i] + 1]
        total = 0.0
        for p in range(begin, end):
            total += np.exp(amplitude[i] * value[p])
        remaining = uniform(child_key(place[i], _SUBVOXEL)) * total
        p = begin
        while p < end - 1:
            remaining -= np.exp(amplitude[i] * value[p])
            if remaining < 0.0:
                break
            p += 1
        # With 8 subvoxels, the four of the near half are first.
        number = p - begin
        is_divided = end - begin == 8
        half = number >> 2 if is_divided else number
        bits = shift[i] - 2 if is_divided else shift[i]
        child = np.int64(number & 3) << bits if is_divided else np.int64(0)
        mask = (np.uint64(1) << np.uint64(bits)) - np.uint64(1)
        for j in range(inside.shape[0]):
            inside[j, i] = child | np.int64(child_key(place[i], _CANDIDATES + 2 * j) & mask)
            nearer[j, i] = 0.5 * (half + uniform(child_key(place[i], _CANDIDATES + 2 * j + 1)))


@exact_jit
def choose_candidates(place: Any, amplitude: Any, value: Any, out: Any) -> None:
    """Choose one candidate position per halo, with probabilities proportional to exp(amplitude G).

    Parameters
    ----------
    place : uint64 array, shape (n,)
        Random key of the position of each halo.
    amplitude : float array, shape (n,)
        Amplitude B of each halo.
    value : float array, shape (candidates, n)
        G at the candidate positions.
    out : int array, shape (n,)
        Output: number of the chosen candidate.
    """
    for i in range(place.size):
        total = 0.0
        for j in range(value.shape[0]):
            total += np.exp(amplitude[i] * value[j, i])
        remaining = uniform(child_key(place[i], _CHOICE)) * total
        j = 0
        while j < value.shape[0] - 1:
            remaining -= np.exp(amplitude[i] * value[j, i])
            if remaining < 0.0:
                break
            j += 1
        out[i] = j


@exact_jit
def sum_matter(direction: Any, value: Any, box: Any, frames: Any, points: Any, planes: Any, out: Any) -> None:
    """Sum the structure of matter below the cells of the box along lines of sight.

    Parameters
    ----------
    direction : float array, shape (3, n)
        Unit vectors of the lines of sight.
    value : float array, shape (s, n)
        G at the points of each line of sight, which are at the same distances for all lines.
    box : tuple
        Gaussian field of the box of simulated matter (float32[cells^3]), number of cells per side, side (Mpc/h), and
        variance of the field.
    frames : tuple of array, shape (s, 3)
        Axes (int64), signs, and shifts in units of the side, of the replica of the box at each distance.
    points : tuple of array, shape (s,)
        Comoving distance (Mpc/h), linear growth, amplitude B, ln <exp(B G)>, and weight in the convergence.
    planes : float array, shape (p,)
        Inverse comoving distances of the sources, h/Mpc, ascending.
    out : float array, shape (p, n)
        Output: the convergence.
    """
    field, cells, length, variance = box
    axes, sign, shift = frames
    chi, growth, amplitude, log_norm, weight = points
    pixels, last = direction.shape[1], cells - 1
    # The convergence is total - moment / (distance of the source).
    total, moment = np.zeros(pixels), np.zeros(pixels)
    # Planes are filled from the nearest one, which is the last, to infinity.
    plane = planes.size - 1
    for s in range(chi.size):
        while plane >= 0 and planes[plane] * chi[s] >= 1.0:
            for p in range(pixels):
                out[plane, p] = total[p] - planes[plane] * moment[p]
            plane -= 1
        along_x, along_y, along_z = direction[axes[s, 0]], direction[axes[s, 1]], direction[axes[s, 2]]
        scale = chi[s] / length
        scale_x, scale_y, scale_z = sign[s, 0] * scale, sign[s, 1] * scale, sign[s, 2] * scale
        offset, previous, density = 0.5 * growth[s] * growth[s] * variance, -1, 0.0
        for p in range(pixels):
            # Positions in the box, in units of its side, modulo 1. Rounding can give exactly 1.
            x, y, z = (
                along_x[p] * scale_x + shift[s, 0],
                along_y[p] * scale_y + shift[s, 1],
                along_z[p] * scale_z + shift[s, 2],
            )
            x, y, z = x - np.floor(x), y - np.floor(y), z - np.floor(z)
            i, j, k = min(int(x * cells), last), min(int(y * cells), last), min(int(z * cells), last)
            index = (i * cells + j) * cells + k
            # Neighbouring lines of sight are often in the same cell of the box.
            if index != previous:
                density = weight[s] * np.exp(growth[s] * np.float64(field[index]) - offset)
                previous = index
            added = density * np.expm1(amplitude[s] * value[s, p] - log_norm[s])
            total[p] += added
            moment[p] += added * chi[s]
    for rest in range(plane, -1, -1):
        for p in range(pixels):
            out[rest, p] = total[p] - planes[rest] * moment[p]


@exact_jit
def spread_pixels(place: Any, kappa: Any, step: Any, radius: Any, out: Any) -> None:
    """Add the convergence of pixels, times a weight, to the nodes of a square grid, and the sum of the weights.

    Parameters
    ----------
    place : float array, shape (2, m)
        Positions x and y of the pixels relative to the centre of the grid, rad.
    kappa : float array, shape (m, p)
        Convergence of the pixels for sources at p distances.
    step : float
        Distance between nodes, rad.
    radius : float
        Angle r beyond which the weight is 0, rad; at the angle theta, it is (1 - (theta / r)^2)^2.
    out : float array, shape (p + 1, side, side)
        The sums by y and x, to which the weighted convergence and, last, the weights are added. The centre of the grid
        is the node side // 2.
    """
    side, planes = out.shape[1], kappa.shape[1]
    for m in range(place.shape[1]):
        x, y = place[0, m] / step + side // 2, place[1, m] / step + side // 2
        first_x, last_x = max(int(np.ceil(x - radius / step)), 0), min(int(np.floor(x + radius / step)), side - 1)
        first_y, last_y = max(int(np.ceil(y - radius / step)), 0), min(int(np.floor(y + radius / step)), side - 1)
        for j in range(first_y, last_y + 1):
            for i in range(first_x, last_x + 1):
                inside = 1.0 - ((i - x) ** 2 + (j - y) ** 2) * (step / radius) ** 2
                if inside > 0.0:
                    weight = inside * inside
                    for plane in range(planes):
                        out[plane, j, i] += weight * kappa[m, plane]
                    out[planes, j, i] += weight
