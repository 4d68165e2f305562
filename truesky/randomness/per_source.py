"""Draw random numbers of many sources so that those of one source do not depend on the other sources.

A source has the same numbers in a deeper or wider catalogue: they depend on the seed, the property, the source and the
number of previous draws, not on the other sources.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float, Int
from truesky.randomness import compiled_draws
from truesky.randomness.rng import key_hex, mix_bits


class PerSourceGenerator:
    """Generator with one number per source and call, and the methods of numpy's generator.

    Sources may be left out later (`select`) without a change in the numbers of the others.
    """

    def __init__(self, ids: Int, *identity: int | str) -> None:
        """Start the streams of sources with distinct identifiers, int64[n]; `identity` is as in `rng.stream`."""
        self._keys, self._calls = keys(ids, *identity), 0

    def select(self, keep: npt.NDArray[np.generic]) -> PerSourceGenerator:
        """Return a generator for selected sources (a mask or row numbers), which continues with their next numbers."""
        new = object.__new__(PerSourceGenerator)
        new._keys, new._calls = self._keys[keep], self._calls
        return new

    def random(self, size: int | None = None) -> Float:
        """Return uniform numbers in (0, 1), shape (n,). `size` must be n if it is given."""
        return self._draw(size, compiled_draws.uniforms)

    def standard_normal(self, size: int | None = None) -> Float:
        """Return standard normal deviates, shape (n,). `size` must be n if it is given."""
        return self._draw(size, compiled_draws.normals)

    def standard_gamma(self, shape: npt.ArrayLike, size: int | None = None) -> Float:
        """Return standard gamma deviates for a shape parameter > 0, float or float[n]; `size` is n if it is given."""
        shapes = np.ascontiguousarray(np.broadcast_to(np.asarray(shape, float), self._keys.shape))
        return self._draw(size, compiled_draws.gammas, shapes)

    def beta(self, a: npt.ArrayLike, b: npt.ArrayLike, size: int | None = None) -> Float:
        """Draw beta deviates in (0, 1).

        Parameters
        ----------
        a, b : float or float array, shape (n,)
            Parameters of the distribution, more than 0.
        size : int, optional
            Number of sources n, if it is given.

        Returns
        -------
        float array, shape (n,)
            One number per source.
        """
        gamma_a, gamma_b = self.standard_gamma(a, size), self.standard_gamma(b, size)
        return gamma_a / (gamma_a + gamma_b)

    def integers(self, low: int, high: int, size: int | None = None) -> Int:
        """Draw uniform integers.

        Parameters
        ----------
        low, high : int
            Range: `low` is included, `high` is not. The range has at most 2^52 numbers.
        size : int, optional
            Number of sources n, if it is given.

        Returns
        -------
        int64 array, shape (n,)
            One number per source.
        """
        return low + (self.random(size) * (high - low)).astype(np.int64)

    def _draw(self, size: int | None, fill_array: Any, *parameters: Float) -> Float:
        if size is not None and size != self._keys.size:
            raise ValueError(f"size must be the number of sources, {self._keys.size}, got {size}")
        out = np.empty(self._keys.size)
        fill_array(self._keys, self._calls, *parameters, out)
        self._calls += 1
        return out


# Type of the generator in functions that draw one number per source.
AnyGenerator = np.random.Generator | PerSourceGenerator


def keys(ids: Int, *identity: int | str) -> npt.NDArray[np.uint64]:
    """Return the key of each source, uint64[n], for compiled draws.

    `ids` are int64[n], and `identity` is as in `rng.stream`. The keys of sources are as independent as the mixing
    function makes them.
    """
    name = key_hex(*identity)
    first, second = np.uint64(int(name[:16], 16)), np.uint64(int(name[16:], 16))
    return np.asarray(mix_bits(mix_bits(np.asarray(ids).astype(np.uint64) ^ first) ^ second), np.uint64)
