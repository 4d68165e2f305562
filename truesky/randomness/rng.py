"""Create random generators whose numbers depend only on an identity, not on where or when the code runs.

An identity consists of integers and texts, such as a seed, the name of a computation and the number of a sky cell. It
is hashed into the key of a counter-based Philox generator. Equal identities give equal numbers on any processor, in
any order of execution, and in repeated attempts. A new computation gets a new name, and does not change the numbers of
the others.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float, Int
from lake_schema.errors import BadInput

# Increment of the counter of the generator SplitMix64.
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
# Factors and shifts of the function by which SplitMix64 mixes bits.
_FIRST, _SECOND = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31 = np.uint64(30), np.uint64(27), np.uint64(31)


def key_hex(*identity: int | str) -> str:
    """Return the 128-bit Philox key of an identity as 32 hexadecimal digits, first 64-bit word first.

    Raises BadInput if the identity does not consist of integers and texts.
    """
    first, second = _key(identity)
    return f"{int(first):016x}{int(second):016x}"


def stream(*identity: int | str) -> np.random.Generator:
    """Return a new numpy generator for an identity, for example stream(seed, "galaxies.shape", cell).

    Generators of equal identities return equal numbers. The identity consists of integers and texts: 1 and "1" differ,
    and so do ("a", "b") and ("ab",). Raises BadInput for other types, such as bool.
    """
    return np.random.Generator(np.random.Philox(key=_key(identity)))


def uniforms(ids: Int, count: int, *identity: int | str) -> Float:
    """Return `count` uniform numbers for each source.

    A number depends only on the identity, the source's identifier and the index of the number.

    Parameters
    ----------
    ids : int64 array, shape (n,)
        Identifiers of the sources.
    count : int
        Number of random numbers per source.
    *identity : int or str
        Integers and texts that identify the purpose, such as a seed and a name; see `stream`.

    Returns
    -------
    float array, shape (count, n)
        Numbers in (0, 1).

    Raises
    ------
    BadInput
        If the identity does not consist of integers and texts.

    References
    ----------
    Steele, Lea & Flood 2014 (SplitMix64: a counter is mixed by a function that changes half of the bits).
    """
    first, second = _key(identity)
    hashed_ids = mix_bits(ids.astype(np.uint64) ^ first)
    # Counters of SplitMix64 for the indices 1 to count; the products of uint64 are taken modulo 2^64.
    counters = (np.arange(count, dtype=np.uint64) + np.uint64(1)) * GOLDEN
    bits = mix_bits((hashed_ids[None, :] ^ second) + counters[:, None])
    # (k + 1/2) 2^-52 with an integer k from 0 to 2^52 - 1 is never rounded to 0 or 1.
    return np.asarray(((bits >> np.uint64(12)) + 0.5) * 2.0**-52)


def mix_bits(words: Any) -> Any:
    """Return hashes of uint64 words, by the function of SplitMix64: a change of one bit changes half of the bits.

    `words` is an array, or a number in code that truesky.numerics.compiling compiles. This module name must stay in
    this docstring: a changed file causes a new compilation only if it contains the name.
    """
    words = (words ^ (words >> _S30)) * _FIRST
    words = (words ^ (words >> _S27)) * _SECOND
    return words ^ (words >> _S31)


def _key(identity: tuple[int | str, ...]) -> npt.NDArray[np.uint64]:
    for part in identity:
        if isinstance(part, bool) or not isinstance(part, (int, str, np.integer)):
            raise BadInput(f"the identity of a random stream must contain integers and strings, got {part!r}")
    canonical = tuple(part if isinstance(part, str) else int(part) for part in identity)
    digest = hashlib.blake2b(repr(canonical).encode(), digest_size=16).digest()
    return np.frombuffer(digest, "<u8").copy()
