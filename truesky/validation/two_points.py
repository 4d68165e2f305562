"""Measure two-point correlation functions of positions and shears of galaxies, with jackknife errors.

For jackknife errors, the field is divided into patches, and each function is also measured once without each patch.

References
----------
Landy & Szalay 1993, ApJ 412, 64
Schneider, van Waerbeke & Mellier 2002, A&A 389, 729
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Float, Int
from truesky.validation import field as fields
from truesky.validation import pairs
from truesky.validation.field import Field

# One arcmin in radians.
ARCMIN = np.radians(1.0 / 60.0)
# Bins below and above this separation (rad) are measured separately. Each time, a random subset of the galaxies is used
# if there are too many pairs; at small separations, all or more galaxies can be used.
_FULL_SAMPLE_LIMIT = 2.5 * ARCMIN
# Number of random positions per galaxy for the estimator of Landy & Szalay.
_RANDOM_PER_GALAXY = 2
# Largest number of random positions for the estimator of Landy & Szalay, in a field with fewer cells than this number;
# otherwise there is one position per cell.
_MAX_RANDOM = 60_000
# Approximate number of random positions whose pairs represent the distribution of separations in a field. A field with
# more cells has one position per cell.
_PLACES = 1500


@dataclass(frozen=True, slots=True, eq=False)
class TwoPointFunction:
    """One or more measured correlation functions in bins of separation, with jackknife samples.

    Attributes
    ----------
    edges : float array, shape (bins + 1,)
        Edges of the separation bins, rad.
    number : float array, shape (bins,)
        Number of pairs of galaxies in each bin.
    value : float array, shape (functions, bins)
        Values of the functions, NaN in bins without pairs.
    jackknife : float array, shape (patches, functions, bins)
        Values measured without the galaxies of each patch.
    """

    edges: Float
    number: Float
    value: Float
    jackknife: Float

    @property
    def theta(self) -> Float:
        """Return the mean separation in each bin (rad) that evenly distributed pairs would have."""
        low, high = self.edges[:-1], self.edges[1:]
        return np.asarray(2.0 / 3.0 * (high**3 - low**3) / (high**2 - low**2))

    @property
    def error(self) -> Float:
        """Return the jackknife standard error, shape (functions, bins); NaN with fewer than six patches."""
        return fields.jackknife_error(self.jackknife)


def angular_correlation(ids: Int, ra: Float, dec: Float, index: Int, field: Field, edges: Float) -> TwoPointFunction:
    """Measure the angular correlation function w of galaxies with the estimator of Landy & Szalay.

    Parameters
    ----------
    ids : int array, shape (n,)
        Identifiers of the galaxies, by which a random subset is selected if there are too many pairs.
    ra, dec : float array, shape (n,)
        Positions, deg.
    index : int array, shape (n,)
        The same positions as nested HEALPix indices of order 29.
    field : Field
        Area of the sky; galaxies outside are ignored.
    edges : float array, shape (bins + 1,)
        Edges of the separation bins, rad, ascending.

    Returns
    -------
    TwoPointFunction
        One function: w.
    """
    patch, place = field.patch_of(index), sky.unit_vectors(ra, dec)
    inside = patch >= 0
    ids, place, patch = ids[inside], place[inside], patch[inside]
    random_points = fields.random_positions(
        field, min(_RANDOM_PER_GALAXY * len(ids), _MAX_RANDOM), "validation", "angular"
    )
    parts = []
    for edge in _split_edges(edges):
        sampled = pairs.thin_sample(ids, place, edge[-1])
        sampled_random = pairs.thin_sample(np.arange(len(random_points[0])), random_points[0], edge[-1])
        samples = [
            (place[sampled], patch[sampled]),
            (random_points[0][sampled_random], random_points[1][sampled_random]),
        ]
        kind = np.repeat([0, 1], [len(positions) for positions, _ in samples])
        place_of, patch_of = (np.concatenate([sample[i] for sample in samples]) for i in (0, 1))
        counts = pairs.count_pairs(place_of, kind, patch_of, edge)
        n_per_patch = np.array([np.bincount(patches, minlength=field.n_patches) for _, patches in samples], float)
        n_without_patch = n_per_patch.sum(1)[:, None] - n_per_patch
        value, jackknife = (
            landy_szalay(counts.total, n_per_patch.sum(1)),
            landy_szalay(counts.jackknife, n_without_patch.T),
        )
        parts.append(TwoPointFunction(edge, counts.total[0], value[None], jackknife[:, None]))
    return _join_bins(edges, parts)


def landy_szalay(count: Float, n_points: Float) -> Float:
    """Return w, shape (..., bins), with the estimator of Landy & Szalay.

    `count`, shape (..., 3, bins), has the numbers of pairs galaxy-galaxy, galaxy-random and random-random. `n_points`,
    shape (..., 2), has the numbers of galaxies and of random positions. w is NaN or infinite without random pairs.
    """
    galaxies, scattered = n_points[..., 0, None], n_points[..., 1, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        by_chance = 2.0 * count[..., 2, :] / scattered / (scattered - 1.0)
        galaxy_pairs = 2.0 * count[..., 0, :] / galaxies / (galaxies - 1.0)
        return np.asarray((galaxy_pairs - count[..., 1, :] / galaxies / scattered * 2.0) / by_chance + 1.0)


def shear_correlations(
    ids: Int, place: tuple[Float, Float], gamma: Float, index: Int, field: Field, edges: Float
) -> TwoPointFunction:
    """Measure the two-point functions of shear and convergence of galaxies.

    Parameters
    ----------
    ids : int array, shape (n,)
        Identifiers of the galaxies, by which a random subset is selected if there are too many pairs.
    place : tuple of float arrays, shape (n,)
        Right ascension and declination, deg.
    gamma : float array, shape (n, 3)
        Shear gamma1, gamma2 in the axes (east, north), and convergence kappa.
    index : int array, shape (n,)
        The same positions as nested HEALPix indices of order 29.
    field : Field
        Area of the sky; galaxies outside are ignored.
    edges : float array, shape (bins + 1,)
        Edges of the separation bins, rad, ascending.

    Returns
    -------
    TwoPointFunction
        Six functions: xi+, xi-, the cross component, <kappa kappa>, <kappa gamma_t> and <kappa gamma_x>.
    """
    patch = field.patch_of(index)
    inside = np.flatnonzero(patch >= 0)
    ra, dec = (axis[inside] for axis in place)
    gamma, patch, ids, parts = gamma[inside], patch[inside], ids[inside], []
    for edge in _split_edges(edges):
        sampled = pairs.thin_sample(ids, sky.unit_vectors(ra, dec), edge[-1])
        sums = pairs.sum_shear_products(ra[sampled], dec[sampled], gamma[sampled], patch[sampled], edge)
        with np.errstate(divide="ignore", invalid="ignore"):
            value, jackknife = sums.total[1:] / sums.total[0], sums.jackknife[:, 1:] / sums.jackknife[:, :1]
        parts.append(TwoPointFunction(edge, sums.total[0], value, jackknife))
    return _join_bins(edges, parts)


def rebin(fine: TwoPointFunction, edges: Float) -> TwoPointFunction:
    """Average a two-point function in wider bins, weighted by the numbers of pairs.

    `edges` (rad, ascending) are the edges of the new bins, each of which must be an edge of `fine`. New bins without
    pairs have the value NaN.
    """
    at = np.searchsorted(fine.edges, edges * (1 + 1e-9)) - 1
    number = np.nan_to_num(fine.number)

    def sum_bins(values: Float) -> Float:
        total = [np.sum((np.nan_to_num(values) * number)[..., i:j], -1) for i, j in pairwise(at)]
        return np.stack(total, -1)

    each = np.array([number[i:j].sum() for i, j in pairwise(at)])
    with np.errstate(divide="ignore", invalid="ignore"):
        return TwoPointFunction(edges, each, sum_bins(fine.value) / each, sum_bins(fine.jackknife) / each)


def mean_over_pairs(field: Field, theta: Float, values: Float) -> float:
    """Average a function of separation over all pairs of positions in a field.

    Parameters
    ----------
    field : Field
        Area of the sky in which the positions are evenly distributed.
    theta : float array, shape (n,)
        Separations at which the function is given, rad, ascending.
    values : float array, shape (n,)
        Values of the function. It is constant below the first separation, and 0 beyond the last.

    Returns
    -------
    float
        Mean over all pairs of about 1500 random positions, or of one position per cell if the field has more cells.
    """
    place, _ = fields.random_positions(field, _PLACES, "validation", "all pairs")
    separations = [np.arccos(np.clip(np.sum(place[i + 1 :] * vector, 1), -1, 1)) for i, vector in enumerate(place)]
    return float(np.mean(np.interp(np.concatenate(separations), theta, values, right=0.0)))


def _split_edges(edges: Float) -> list[Float]:
    """Divide edges of separation bins (rad) at the last edge up to 2.5 arcmin into two arrays that share this edge.

    Separations in the two arrays are measured with different random subsets of the galaxies, because more galaxies can
    be used for small separations. An array without any bin is left out.
    """
    cut = int(np.searchsorted(edges, _FULL_SAMPLE_LIMIT, side="right")) - 1
    return [part for part in (edges[: cut + 1], edges[max(cut, 0) :]) if len(part) > 1]


def _join_bins(edges: Float, parts: list[TwoPointFunction]) -> TwoPointFunction:
    number, value, jackknife = (
        np.concatenate([getattr(part, name) for part in parts], -1) for name in ("number", "value", "jackknife")
    )
    return TwoPointFunction(edges, number, value, jackknife)
