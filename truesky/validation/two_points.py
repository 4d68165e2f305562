"""Correlations of galaxies on the sky, by separation, with what they are without each patch of the field.

angular   w of positions, by Landy & Szalay's estimator
shear     xi+, xi-, their cross component, and what convergence and shear have in common
Measured  either

Ref: Landy & Szalay 1993, ApJ 412, 64; Schneider, van Waerbeke & Mellier 2002, A&A 389, 729
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
# Separations, rad, that all galaxies are taken for; of larger ones there are pairs enough of some of them.
_FULL_SAMPLE_LIMIT = 2.5 * ARCMIN
# Random places, of one galaxy and at most.
_RANDOM_PER_GALAXY, _MAX_RANDOM = 2, 60_000
# Places whose pairs stand for all of a field.
_PLACES = 1500


@dataclass(frozen=True, slots=True, eq=False)
class TwoPointFunction:
    """edges : float[bin + 1] rad;  number : float[bin] of pairs;  value : float[c, bin];  without : [patch, c, bin]."""

    edges: Float
    number: Float
    value: Float
    jackknife: Float

    @property
    def theta(self) -> Float:
        """Mean separation of pairs spread evenly, rad."""
        low, high = self.edges[:-1], self.edges[1:]
        return np.asarray(2.0 / 3.0 * (high**3 - low**3) / (high**2 - low**2))

    @property
    def error(self) -> Float:
        """float[c, bin]."""
        return fields.jackknife_error(self.jackknife)


def angular_correlation(ids: Int, ra: Float, dec: Float, index: Int, field: Field, edges: Float) -> TwoPointFunction:
    """w of galaxies.

    ids, index : int[n] identifiers and order-29 indices;  ra, dec : float[n] deg
    field      : that they lie in;  edges : of separations, rad
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
    """w[..., bin] of pairs[..., 3, bin] of many[..., 2] galaxies and random places."""
    galaxies, scattered = n_points[..., 0, None], n_points[..., 1, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        by_chance = 2.0 * count[..., 2, :] / scattered / (scattered - 1.0)
        galaxy_pairs = 2.0 * count[..., 0, :] / galaxies / (galaxies - 1.0)
        return np.asarray((galaxy_pairs - count[..., 1, :] / galaxies / scattered * 2.0) / by_chance + 1.0)


def shear_correlations(
    ids: Int, place: tuple[Float, Float], gamma: Float, index: Int, field: Field, edges: Float
) -> TwoPointFunction:
    """xi+, xi-, cross, <kappa kappa>, <kappa gamma_t>, <kappa gamma_x>.

    ids, index : as of `angular`;  place : ra, dec[n] deg;  gamma : float[n, 3] gamma1, gamma2 (east, north), kappa
    field, edges : as of `angular`
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
    """Of wider bins; edges : some of those of `fine`, rad."""
    at = np.searchsorted(fine.edges, edges * (1 + 1e-9)) - 1
    number = np.nan_to_num(fine.number)

    def sum_bins(values: Float) -> Float:
        total = [np.sum((np.nan_to_num(values) * number)[..., i:j], -1) for i, j in pairwise(at)]
        return np.stack(total, -1)

    each = np.array([number[i:j].sum() for i, j in pairwise(at)])
    with np.errstate(divide="ignore", invalid="ignore"):
        return TwoPointFunction(edges, each, sum_bins(fine.value) / each, sum_bins(fine.jackknife) / each)


def mean_over_pairs(field: Field, theta: Float, values: Float) -> float:
    """Mean over all pairs of places in a field of what has values[n] at theta[n] rad, 0 beyond."""
    place, _ = fields.random_positions(field, _PLACES, "validation", "all pairs")
    separations = [np.arccos(np.clip(np.sum(place[i + 1 :] * vector, 1), -1, 1)) for i, vector in enumerate(place)]
    return float(np.mean(np.interp(np.concatenate(separations), theta, values, right=0.0)))


def _split_edges(edges: Float) -> list[Float]:
    """Near and far separations."""
    cut = int(np.searchsorted(edges, _FULL_SAMPLE_LIMIT, side="right")) - 1
    return [part for part in (edges[: cut + 1], edges[max(cut, 0) :]) if len(part) > 1]


def _join_bins(edges: Float, parts: list[TwoPointFunction]) -> TwoPointFunction:
    number, value, jackknife = (
        np.concatenate([getattr(part, name) for part in parts], -1) for name in ("number", "value", "without")
    )
    return TwoPointFunction(edges, number, value, jackknife)
