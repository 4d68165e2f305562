"""Create random generators that are keyed by the identity of a draw, not by where or when the code runs.

A stream's identity (seed, stage, cell, source, detector, effect, ...) is hashed into the key of a counter-based Philox
generator. Equal identities give equal numbers on any core, in any order, and in repeated attempts. A new stage has a
new name and does not change the numbers of the others.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float, Int
from lake_schema.errors import BadInput

# Increment of the counter of SplitMix64.
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST, _SECOND = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31 = np.uint64(30), np.uint64(27), np.uint64(31)


def key_hex(*identity: int | str) -> str:
    """Return the key of an identity's generator as 32 hexadecimal digits, with the first word of Philox's key first."""
    first, second = _key(identity)
    return f"{int(first):016x}{int(second):016x}"


def stream(*identity: int | str) -> np.random.Generator:
    """Return the generator of an identity, for example stream(seed, "galaxies.shape", cell).

    The identity consists of integers and strings: 1 and "1" differ, and so do ("a", "b") and ("ab",).
    """
    return np.random.Generator(np.random.Philox(key=_key(identity)))


def uniforms(ids: Int, count: int, *identity: int | str) -> Float:
    """Draw uniform numbers per source, each a function of only the identity, the source and its index.

    Parameters
    ----------
    ids : int64 array, shape (n,)
        Identifiers of the sources.
    count : int
        Numbers per source.
    *identity : int or str
        Same as in `stream`.

    Returns
    -------
    float array, shape (count, n)
        Numbers in (0, 1).

    References
    ----------
    Steele, Lea & Flood 2014 (SplitMix64: a counter is mixed by a function that changes half of the bits).
    """
    first, second = _key(identity)
    hashed_ids = mix_bits(ids.astype(np.uint64) ^ first)
    # The arithmetic is modulo 2^64.
    counters = (np.arange(count, dtype=np.uint64) + np.uint64(1)) * GOLDEN
    bits = mix_bits((hashed_ids[None, :] ^ second) + counters[:, None])
    # A multiple of 2^-52 plus a half is never rounded to 0 or 1.
    return np.asarray(((bits >> np.uint64(12)) + 0.5) * 2.0**-52)


def mix_bits(words: Any) -> Any:
    """Mix uint64 words with the function of SplitMix64, which changes half of the bits.

    The words are arrays, or scalars in code that truesky.numerics.compiling compiles. Because this file names that
    module, it is part of the key of the machine code.
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
