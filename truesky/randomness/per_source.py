"""Random numbers of many sources, each source's its own, whichever others they are drawn with.

Keyed    in place of numpy's generator, where one call draws one number for each source
keys     of sources: what compiled draws start from

A source has the same numbers in a catalogue that is deeper or wider: they are a function of seed, property and source,
and of how many the property has drawn before, not of the other sources.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float, Int
from truesky.randomness import compiled_draws
from truesky.randomness.rng import key_hex, mix_bits


class PerSourceGenerator:
    """Of sources' identifiers and of an identity: one number a source and call, as numpy's generator names them.

    Sources that are left out later leave the others' numbers as they are (`part`).
    """

    def __init__(self, ids: Int, *identity: int | str) -> None:
        """ids : int64[n], distinct;  identity : as of truesky.randomness.rng.stream"""
        self._keys, self._calls = keys(ids, *identity), 0

    def select(self, keep: npt.NDArray[np.generic]) -> PerSourceGenerator:
        """Of the sources that are kept, from here on: keep : bool or int[m] rows."""
        new = object.__new__(PerSourceGenerator)
        new._keys, new._calls = self._keys[keep], self._calls
        return new

    def random(self, size: int | None = None) -> Float:
        """Uniform in (0, 1), [n]; size : n, if it is given."""
        return self._draw(size, compiled_draws.uniforms)

    def standard_normal(self, size: int | None = None) -> Float:
        """Normal, [n]; size : n, if it is given."""
        return self._draw(size, compiled_draws.normals)

    def standard_gamma(self, shape: npt.ArrayLike, size: int | None = None) -> Float:
        """Of a shape > 0, a number or float[n]; size : n, if it is given."""
        shapes = np.ascontiguousarray(np.broadcast_to(np.asarray(shape, float), self._keys.shape))
        return self._draw(size, compiled_draws.gammas, shapes)

    def beta(self, a: npt.ArrayLike, b: npt.ArrayLike, size: int | None = None) -> Float:
        """In (0, 1), of a, b > 0, numbers or float[n]; size : n, if it is given."""
        gamma_a, gamma_b = self.standard_gamma(a, size), self.standard_gamma(b, size)
        return gamma_a / (gamma_a + gamma_b)

    def integers(self, low: int, high: int, size: int | None = None) -> Int:
        """In [low, high), at most 2^52 of them, [n]; size : n, if it is given."""
        return low + (self.random(size) * (high - low)).astype(np.int64)

    def _draw(self, size: int | None, fill_array: Any, *parameters: Float) -> Float:
        if size is not None and size != self._keys.size:
            raise ValueError(f"{size} numbers are wanted of {self._keys.size} sources")
        out = np.empty(self._keys.size)
        fill_array(self._keys, self._calls, *parameters, out)
        self._calls += 1
        return out


# What draws take that want one number of each source.
AnyGenerator = np.random.Generator | PerSourceGenerator


def keys(ids: Int, *identity: int | str) -> npt.NDArray[np.uint64]:
    """Words, [n], as independent as a mixer makes them.

    ids : int64[n];  identity : as of truesky.randomness.rng.stream
    """
    name = key_hex(*identity)
    first, second = np.uint64(int(name[:16], 16)), np.uint64(int(name[16:], 16))
    return np.asarray(mix_bits(mix_bits(np.asarray(ids).astype(np.uint64) ^ first) ^ second), np.uint64)
