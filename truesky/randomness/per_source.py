"""Draw random numbers for many sources, such that the numbers of a source do not depend on the other sources.

The numbers depend on the seed, the name of the property that is drawn, the source's identifier and the number of
previous draws. A source therefore has the same numbers in a deeper or wider catalogue.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float, Int
from truesky.randomness import compiled_draws
from truesky.randomness.rng import key_hex, mix_bits


class PerSourceGenerator:
    """Random generator for n sources: each call of a method returns one number per source.

    Its methods have the same names as in numpy.random.Generator. Sources may be left out with `select`, which does not
    change the numbers of the other sources.
    """

    def __init__(self, ids: Int, *identity: int | str) -> None:
        """Create the generator of n sources with the given identifiers, int64[n].

        `identity` are integers and texts that identify the purpose, such as a seed and "galaxies.shape". Sources with
        equal identifiers get equal numbers.
        """
        self._keys, self._calls = keys(ids, *identity), 0

    def select(self, keep: npt.NDArray[np.generic]) -> PerSourceGenerator:
        """Return a generator for some of the sources, given by a boolean mask or by indices.

        Its first numbers are the numbers that this generator would return next for these sources.
        """
        new = object.__new__(PerSourceGenerator)
        new._keys, new._calls = self._keys[keep], self._calls
        return new

    def random(self, size: int | None = None) -> Float:
        """Return one uniform number in (0, 1) per source, shape (n,).

        Raises ValueError if `size` is given and is not the number of sources n.
        """
        return self._draw(size, compiled_draws.uniforms)

    def standard_normal(self, size: int | None = None) -> Float:
        """Return one standard normal deviate per source, shape (n,).

        Raises ValueError if `size` is given and is not the number of sources n.
        """
        return self._draw(size, compiled_draws.normals)

    def standard_gamma(self, shape: npt.ArrayLike, size: int | None = None) -> Float:
        """Return one standard gamma deviate per source, shape (n,).

        `shape` is the shape parameter, above 0 (not checked), as a number or as one number per source. Raises
        ValueError if `size` is given and is not the number of sources n.
        """
        shapes = np.ascontiguousarray(np.broadcast_to(np.asarray(shape, float), self._keys.shape))
        return self._draw(size, compiled_draws.gammas, shapes)

    def beta(self, a: npt.ArrayLike, b: npt.ArrayLike, size: int | None = None) -> Float:
        """Return one beta deviate in (0, 1) per source.

        Parameters
        ----------
        a, b : float or float array, shape (n,)
            Parameters of the distribution, above 0, which is not checked.
        size : int, optional
            Number of sources n; ValueError is raised for another number.

        Returns
        -------
        float array, shape (n,)
            One number per source.
        """
        gamma_a, gamma_b = self.standard_gamma(a, size), self.standard_gamma(b, size)
        return gamma_a / (gamma_a + gamma_b)

    def integers(self, low: int, high: int, size: int | None = None) -> Int:
        """Return one uniform integer per source.

        Parameters
        ----------
        low, high : int
            Range: `low` is included, `high` is not. The range must have 1 to 2^52 numbers, which is not checked.
        size : int, optional
            Number of sources n; ValueError is raised for another number.

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


# Type of the random generator that is accepted by functions that draw one number per source and call.
AnyGenerator = np.random.Generator | PerSourceGenerator


def keys(ids: Int, *identity: int | str) -> npt.NDArray[np.uint64]:
    """Return the random key of each source, uint64[n], for the functions of `compiled_draws`.

    `ids` are the identifiers of the sources, int64[n]. `identity` are integers and texts that identify the purpose,
    such as a seed and "galaxies.shape". Each key is a hash of the identifier and `identity`. Raises BadInput if
    `identity` contains another type.
    """
    name = key_hex(*identity)
    first, second = np.uint64(int(name[:16], 16)), np.uint64(int(name[16:], 16))
    return np.asarray(mix_bits(mix_bits(np.asarray(ids).astype(np.uint64) ^ first) ^ second), np.uint64)
