"""Structure of the density of halos on scales below the voxels of the box of simulated matter (4 Mpc/h).

The number density of halos (and of the matter around them, see `fine_convergence`) is multiplied by a log-normal
field, which depends only on the seed and the comoving position x relative to the observer::

    n(x) = n_voxel exp(B G(x)) / <exp(B G)>

G is Gaussian to a good approximation, with mean 0 and variance 1: a sum of octaves of lattice noise. It has no
correlation between positions that differ by more than two lattice steps along any axis of the lattice, so the
clustering on larger scales does not change. The amplitude B depends on the bias of the halos; fine_structure.toml lists
the amplitudes.

Each voxel (small piece of volume) is divided into subvoxels. The mean of exp(B G) at their centres multiplies the
number of halos of the voxel. A halo is in one of the subvoxels, chosen by weight, and there at one of several candidate
positions, also chosen by weight. All choices are made with hashes of the random bits of the halo.

Notes
-----
Two populations of halos with amplitudes B_1 and B_2 have 1 + xi = (1 + xi_voxels) exp(B_1 B_2 C(r)), where C(r) is the
correlation function of G, averaged over directions.

References
----------
Coles & Jones 1991, MNRAS 248, 1 (log-normal fields)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lake_schema import sky
from lake_schema.arrays import Float, Int, UInt32
from lake_schema.lazy_healpy import healpy as hp
from truesky.catalogue import parameters
from truesky.catalogue.matter import compiled_fine_structure as compiled
from truesky.catalogue.matter import lightcone
from truesky.catalogue.matter.lightcone import Steps, Voxels
from truesky.numerics import matrices
from truesky.randomness import per_source

# Number of nodes per axis of the quadrature over positions in a lattice cell; the norms have a relative error of 1e-8.
_NODES = 6


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of the structure; explained in fine_structure.toml. `steps` and `widest_undivided` are in Mpc/h."""

    steps: tuple[float, ...]
    variances: tuple[float, ...]
    amplitudes: tuple[float, ...]
    widest_undivided: float
    candidates: int


@dataclass(frozen=True, slots=True, eq=False)
class FineStructure:
    """Field G(x) of one seed, and its effect on the density of halos.

    Attributes
    ----------
    parameters : Parameters
        Lattice steps and amplitudes.
    keys : uint32 array, shape (octaves, 2)
        Random keys of each octave.
    scatter : float array, shape (octaves,)
        Standard deviation of each octave; the sum of their squares is 1.
    amplitude : float array, shape (fields,)
        B of the halos that follow each smoothed field of the box.
    norm : float array, shape (fields,)
        Mean of exp(B G).
    """

    parameters: Parameters
    keys: UInt32
    scatter: Float
    amplitude: Float
    norm: Float


@dataclass(frozen=True, slots=True, eq=False)
class Subvoxels:
    """Subvoxels of voxels, and the weights of the voxels.

    Attributes
    ----------
    first : int array, shape (v + 1,)
        First subvoxel of each voxel; the last value is the number of subvoxels, p.
    value : float array, shape (p,)
        G at the centre of each subvoxel. Subvoxels in the near half of a voxel are first.
    weight : float array, shape (v, fields)
        Mean of exp(B G) / <exp(B G)> over the subvoxels of each voxel, for the halos that follow each smoothed field.
    """

    first: Int
    value: Float
    weight: Float


def model(seed: int) -> FineStructure:
    """Return the structure of a seed, with the built-in parameters."""
    chosen = Parameters(**parameters.section("fine_structure.toml", "fine_structure"))
    keys = per_source.keys(np.arange(len(chosen.steps)), seed, "fine_structure")
    halves = np.stack([keys & np.uint64(0xFFFFFFFF), keys >> np.uint64(32)], 1).astype(np.uint32)
    variances = np.array(chosen.variances)
    scatter = np.sqrt(variances / variances.sum())
    amplitude = np.array(chosen.amplitudes)
    return FineStructure(chosen, halves, scatter, amplitude, mean_exponential(scatter, amplitude))


def mean_exponential(scatter: Float, amplitude: Float) -> Float:
    """Return the mean of exp(B G) over all positions and seeds, for each amplitude B.

    Parameters
    ----------
    scatter : float array, shape (octaves,)
        Standard deviation of each octave of G.
    amplitude : float array, shape (n,)
        Amplitudes B, not 0.

    Returns
    -------
    float array, shape (n,)
        The means, slightly below exp(B^2 / 2), because the numbers of lattice points are limited.

    Notes
    -----
    The number of a lattice point is the sum of four uniform bytes, with a known generating function. For a position in
    a lattice cell the mean is a product over the eight lattice points around it. It is integrated over the cell by
    Gauss-Legendre quadrature.
    """
    node, node_weight = matrices.gauss_legendre(_NODES)
    # By symmetry one half of each axis is sufficient: positions 0 to 0.5 of the lattice step.
    low = 0.25 * (node + 1.0)
    share = np.stack([1.0 - low, low]) / np.sqrt(1.0 - 2.0 * low * (1.0 - low))
    corner = np.einsum("ai,bj,ck->abcijk", share, share, share).reshape(8, -1)
    weight = np.einsum("i,j,k->ijk", node_weight, node_weight, node_weight).ravel() / 8.0
    # Half the factor of a byte in the exponential, by amplitude, octave, lattice point and node. The mean of exp(2 h b)
    # over the 256 bytes b, relative to their mean, is sinh(256 h) / (256 sinh(h)).
    half = 0.5 * np.multiply.outer(np.multiply.outer(amplitude, scatter / compiled.BYTE_SCATTER), corner)
    at_nodes = np.prod((np.sinh(256.0 * half) / (256.0 * np.sinh(half))) ** 4, axis=2)
    return np.asarray(np.prod(np.sum(weight * at_nodes, 2), axis=1))


def values(structure: FineStructure, vector: Float, chi: Float) -> Float:
    """Return G at positions.

    Parameters
    ----------
    structure : FineStructure
        Structure of a seed.
    vector : float array, shape (3, n)
        Unit vectors from the observer to the positions.
    chi : float array, shape (n,)
        Comoving distances, Mpc/h.

    Returns
    -------
    float array, shape (n,)
        G, with mean 0 and variance 1.
    """
    out = np.zeros(chi.size)
    for (key_1, key_2), step, scatter in zip(
        structure.keys, structure.parameters.steps, structure.scatter.tolist(), strict=True
    ):
        compiled.add_octave(key_1, key_2, step, scatter, vector, chi, out)
    return out


def divide(structure: FineStructure, steps: Steps, voxels: Voxels) -> Subvoxels:
    """Divide voxels into subvoxels, and compute the weights of the voxels.

    Parameters
    ----------
    structure : FineStructure
        Structure of a seed.
    steps : Steps
        Steps in comoving distance.
    voxels : Voxels
        Voxels from `lightcone.voxels`: in each step, the same cells of one order.

    Returns
    -------
    Subvoxels
        The subvoxels: 8 per voxel wider than `widest_undivided` of the parameters, 2 per other voxel.
    """
    # The first items are empty, so that no voxels have no subvoxels.
    vectors, distances, counts = [np.zeros((3, 0))], [np.zeros(0)], [np.zeros(0, np.int64)]
    for order in np.unique(voxels.order).tolist():
        rows = slice(*np.searchsorted(voxels.order, [order, order + 1]))
        step, cell = np.unique(voxels.step[rows]), np.unique(voxels.cell[rows])
        is_wide = lightcone.width(order, steps.middle[step]) > structure.parameters.widest_undivided
        # Steps are in the order of distance, so the narrow voxels of an order are first.
        for selected, depth in ((step[~is_wide], 0), (step[is_wide], 1)):
            children = (cell << 2 * depth)[:, None] + np.arange(1 << 2 * depth)
            direction = np.stack(hp.pix2vec(1 << (order + depth), children, nest=True))
            shape = (selected.size, cell.size, 2, children.shape[1])
            vectors.append(np.broadcast_to(direction[:, None, :, None], (3, *shape)).reshape(3, -1))
            chi = distance_at(steps, selected, np.array([[0.25], [0.75]]))
            distances.append(np.broadcast_to(chi.T[:, None, :, None], shape).ravel())
            counts.append(np.full(selected.size * cell.size, 2 * children.shape[1]))
    first = np.append(0, np.cumsum(np.concatenate(counts)))
    value = values(structure, np.concatenate(vectors, 1), np.concatenate(distances))
    weight = np.empty((voxels.step.size, structure.amplitude.size))
    compiled.mean_weights(value, first, structure.amplitude, structure.norm, weight)
    return Subvoxels(first, value, weight)


def distance_at(steps: Steps, step: Int, nearer: Float) -> Float:
    """Return the comoving distances at which a fraction of the volume of a step is nearer.

    Parameters
    ----------
    steps : Steps
        Steps in comoving distance.
    step : int array, shape (n,)
        Numbers of the steps.
    nearer : float array, shape (n,) or (m, n)
        Fractions of the volume.

    Returns
    -------
    float array, shape (n,) or (m, n)
        Comoving distances, Mpc/h.
    """
    inner, outer = steps.edge[step], steps.edge[step + 1]
    return np.asarray(np.cbrt(inner**3 + nearer * (outer**3 - inner**3)))


def place_halos(
    structure: FineStructure,
    steps: Steps,
    voxels: Voxels,
    subvoxels: Subvoxels,
    drawn: tuple[Int, Int, npt.NDArray[np.uint64]],
) -> tuple[Int, Float]:
    """Return the positions of halos in their voxels.

    Parameters
    ----------
    structure : FineStructure
        Structure of a seed.
    steps : Steps
        Steps in comoving distance.
    voxels : Voxels
        Voxels of the light-cone.
    subvoxels : Subvoxels
        Their subvoxels, from `divide`.
    drawn : tuple of array
        Voxel, number of the smoothed field that the halo follows, and random key of the position of each halo, shape
        (n,) each.

    Returns
    -------
    index : int array, shape (n,)
        Nested index of the HEALPix cell of order 29.
    chi : float array, shape (n,)
        Comoving distance, Mpc/h.
    """
    voxel, field, place = drawn
    amplitude, shift = structure.amplitude[field], 2 * (sky.MAX_ORDER - voxels.order[voxel])
    shape = (structure.parameters.candidates, voxel.size)
    inside, nearer = np.empty(shape, np.int64), np.empty(shape)
    compiled.fill_candidates(place, voxel, amplitude, subvoxels.value, subvoxels.first, shift, (inside, nearer))
    index, chi = (voxels.cell[voxel] << shift) | inside, distance_at(steps, voxels.step[voxel], nearer)
    vector = np.stack(hp.pix2vec(1 << sky.MAX_ORDER, index.ravel(), nest=True))
    chosen = np.empty(voxel.size, np.int64)
    compiled.choose_candidates(place, amplitude, values(structure, vector, chi.ravel()).reshape(shape), chosen)
    row = np.arange(voxel.size)
    return index[chosen, row], chi[chosen, row]
