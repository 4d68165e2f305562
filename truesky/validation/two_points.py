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
_NEAR = 2.5 * ARCMIN
# Random places, of one galaxy and at most.
_RANDOM, _MOST_RANDOM = 2, 60_000
# Places whose pairs stand for all of a field.
_PLACES = 1500


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """edges : float[bin + 1] rad;  number : float[bin] of pairs;  value : float[c, bin];  without : [patch, c, bin]."""

    edges: Float
    number: Float
    value: Float
    without: Float

    @property
    def theta(self) -> Float:
        """Mean separation of pairs spread evenly, rad."""
        low, high = self.edges[:-1], self.edges[1:]
        return np.asarray(2.0 / 3.0 * (high**3 - low**3) / (high**2 - low**2))

    @property
    def error(self) -> Float:
        """float[c, bin]."""
        return fields.spread(self.without)


def angular(ids: Int, ra: Float, dec: Float, index: Int, field: Field, edges: Float) -> Measured:
    """w of galaxies.

    ids, index : int[n] identifiers and order-29 indices;  ra, dec : float[n] deg
    field      : that they lie in;  edges : of separations, rad
    """
    patch, place = field.patch_of(index), sky.unit_vectors(ra, dec)
    inside = patch >= 0
    ids, place, patch = ids[inside], place[inside], patch[inside]
    scattered = fields.random(field, min(_RANDOM * len(ids), _MOST_RANDOM), "validation", "angular")
    parts = []
    for edge in _parts(edges):
        kept = pairs.thinned(ids, place, edge[-1])
        chosen = pairs.thinned(np.arange(len(scattered[0])), scattered[0], edge[-1])
        own = [(place[kept], patch[kept]), (scattered[0][chosen], scattered[1][chosen])]
        kind = np.repeat([0, 1], [len(one) for one, _ in own])
        place_of, patch_of = (np.concatenate([one[i] for one in own]) for i in (0, 1))
        found = pairs.counted(place_of, kind, patch_of, edge)
        many = np.array([np.bincount(one, minlength=field.patches) for _, one in own], float)
        left = many.sum(1)[:, None] - many
        value, without = _landy_szalay(found.total, many.sum(1)), _landy_szalay(found.without, left.T)
        parts.append(Measured(edge, found.total[0], value[None], without[:, None]))
    return _joined(edges, parts)


def _landy_szalay(count: Float, many: Float) -> Float:
    """w[..., bin] of pairs[..., 3, bin] of many[..., 2] galaxies and random places."""
    galaxies, scattered = many[..., 0, None], many[..., 1, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        by_chance = 2.0 * count[..., 2, :] / scattered / (scattered - 1.0)
        both = 2.0 * count[..., 0, :] / galaxies / (galaxies - 1.0)
        return np.asarray((both - count[..., 1, :] / galaxies / scattered * 2.0) / by_chance + 1.0)


def shear(ids: Int, place: tuple[Float, Float], gamma: Float, index: Int, field: Field, edges: Float) -> Measured:
    """xi+, xi-, cross, <kappa kappa>, <kappa gamma_t>, <kappa gamma_x>.

    ids, index : as of `angular`;  place : ra, dec[n] deg;  gamma : float[n, 3] gamma1, gamma2 (east, north), kappa
    field, edges : as of `angular`
    """
    patch = field.patch_of(index)
    inside = np.flatnonzero(patch >= 0)
    ra, dec = (axis[inside] for axis in place)
    gamma, patch, ids, parts = gamma[inside], patch[inside], ids[inside], []
    for edge in _parts(edges):
        kept = pairs.thinned(ids, sky.unit_vectors(ra, dec), edge[-1])
        found = pairs.sheared(ra[kept], dec[kept], gamma[kept], patch[kept], edge)
        with np.errstate(divide="ignore", invalid="ignore"):
            value, without = found.total[1:] / found.total[0], found.without[:, 1:] / found.without[:, :1]
        parts.append(Measured(edge, found.total[0], value, without))
    return _joined(edges, parts)


def grouped(fine: Measured, edges: Float) -> Measured:
    """Of wider bins; edges : some of those of `fine`, rad."""
    at = np.searchsorted(fine.edges, edges * (1 + 1e-9)) - 1
    number = np.nan_to_num(fine.number)

    def summed(values: Float) -> Float:
        total = [np.sum((np.nan_to_num(values) * number)[..., i:j], -1) for i, j in pairwise(at)]
        return np.stack(total, -1)

    each = np.array([number[i:j].sum() for i, j in pairwise(at)])
    with np.errstate(divide="ignore", invalid="ignore"):
        return Measured(edges, each, summed(fine.value) / each, summed(fine.without) / each)


def of_all_pairs(field: Field, theta: Float, values: Float) -> float:
    """Mean over all pairs of places in a field of what has values[n] at theta[n] rad, 0 beyond."""
    place, _ = fields.random(field, _PLACES, "validation", "all pairs")
    apart = [np.arccos(np.clip(np.sum(place[i + 1 :] * one, 1), -1, 1)) for i, one in enumerate(place)]
    return float(np.mean(np.interp(np.concatenate(apart), theta, values, right=0.0)))


def _parts(edges: Float) -> list[Float]:
    """Near and far separations."""
    cut = int(np.searchsorted(edges, _NEAR, side="right")) - 1
    return [part for part in (edges[: cut + 1], edges[max(cut, 0) :]) if len(part) > 1]


def _joined(edges: Float, parts: list[Measured]) -> Measured:
    number, value, without = (
        np.concatenate([getattr(part, name) for part in parts], -1) for name in ("number", "value", "without")
    )
    return Measured(edges, number, value, without)
