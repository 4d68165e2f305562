"""Two-point correlations of galaxies by separation on the sky, with jackknife samples without each patch of the field.

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

ARCMIN = np.radians(1.0 / 60.0)
# Up to this separation (rad) all galaxies are used; beyond it a random subset has enough pairs.
_FULL_SAMPLE_LIMIT = 2.5 * ARCMIN
# Random positions per galaxy, and their largest number.
_RANDOM_PER_GALAXY, _MAX_RANDOM = 2, 60_000
# Number of random positions whose pairs represent all pairs of a field.
_PLACES = 1500


@dataclass(frozen=True, slots=True, eq=False)
class TwoPointFunction:
    """Two-point functions by separation.

    Attributes
    ----------
    edges : float array, shape (bins + 1,)
        Edges of the separation bins, rad.
    number : float array, shape (bins,)
        Number of pairs.
    value : float array, shape (c, bins)
        Values of c functions.
    jackknife : float array, shape (patches, c, bins)
        Values without each patch.
    """

    edges: Float
    number: Float
    value: Float
    jackknife: Float

    @property
    def theta(self) -> Float:
        """Mean separation per bin of evenly distributed pairs, rad."""
        low, high = self.edges[:-1], self.edges[1:]
        return np.asarray(2.0 / 3.0 * (high**3 - low**3) / (high**2 - low**2))

    @property
    def error(self) -> Float:
        """Jackknife standard error, shape (c, bins)."""
        return fields.jackknife_error(self.jackknife)


def angular_correlation(ids: Int, ra: Float, dec: Float, index: Int, field: Field, edges: Float) -> TwoPointFunction:
    """Measure the angular correlation function w of galaxies with the estimator of Landy & Szalay.

    Parameters
    ----------
    ids : int array, shape (n,)
        Identifiers.
    ra, dec : float array, shape (n,)
        Positions, deg.
    index : int array, shape (n,)
        Order-29 indices of the positions.
    field : Field
        Area of the galaxies; those outside are ignored.
    edges : float array, shape (bins + 1,)
        Edges of the separation bins, rad, ascending.

    Returns
    -------
    TwoPointFunction
        w, with c = 1.
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
            _landy_szalay(counts.total, n_per_patch.sum(1)),
            _landy_szalay(counts.jackknife, n_without_patch.T),
        )
        parts.append(TwoPointFunction(edge, counts.total[0], value[None], jackknife[:, None]))
    return _join_bins(edges, parts)


def _landy_szalay(count: Float, n_points: Float) -> Float:
    """w, shape (..., bin), from numbers of pairs (..., 3, bin) and of galaxies and random positions (..., 2)."""
    galaxies, scattered = n_points[..., 0, None], n_points[..., 1, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        by_chance = 2.0 * count[..., 2, :] / scattered / (scattered - 1.0)
        galaxy_pairs = 2.0 * count[..., 0, :] / galaxies / (galaxies - 1.0)
        return np.asarray((galaxy_pairs - count[..., 1, :] / galaxies / scattered * 2.0) / by_chance + 1.0)


def shear_correlations(
    ids: Int, place: tuple[Float, Float], gamma: Float, index: Int, field: Field, edges: Float
) -> TwoPointFunction:
    """Measure xi+, xi-, cross, <kappa kappa>, <kappa gamma_t> and <kappa gamma_x>.

    Parameters
    ----------
    ids : int array, shape (n,)
        Identifiers.
    place : tuple of float arrays, shape (n,)
        Right ascension and declination, deg.
    gamma : float array, shape (n, 3)
        gamma1, gamma2 in the frame (east, north), and kappa.
    index : int array, shape (n,)
        Order-29 indices of the positions.
    field : Field
        Area of the galaxies; those outside are ignored.
    edges : float array, shape (bins + 1,)
        Edges of the separation bins, rad, ascending.

    Returns
    -------
    TwoPointFunction
        The six functions, with c = 6.
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
    """Average a two-point function in wider bins; `edges` (rad) is a subset of its edges."""
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
        Area that the positions fill.
    theta : float array, shape (n,)
        Separations, rad, ascending.
    values : float array, shape (n,)
        Values of the function, 0 beyond the last separation.

    Returns
    -------
    float
        Mean over random pairs.
    """
    place, _ = fields.random_positions(field, _PLACES, "validation", "all pairs")
    separations = [np.arccos(np.clip(np.sum(place[i + 1 :] * vector, 1), -1, 1)) for i, vector in enumerate(place)]
    return float(np.mean(np.interp(np.concatenate(separations), theta, values, right=0.0)))


def _split_edges(edges: Float) -> list[Float]:
    """Small separations, for all galaxies, and large separations, for a subset."""
    cut = int(np.searchsorted(edges, _FULL_SAMPLE_LIMIT, side="right")) - 1
    return [part for part in (edges[: cut + 1], edges[max(cut, 0) :]) if len(part) > 1]


def _join_bins(edges: Float, parts: list[TwoPointFunction]) -> TwoPointFunction:
    number, value, jackknife = (
        np.concatenate([getattr(part, name) for part in parts], -1) for name in ("number", "value", "jackknife")
    )
    return TwoPointFunction(edges, number, value, jackknife)
