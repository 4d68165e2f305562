"""Random numbers keyed by what is drawn, never by where or when it runs.

A stream's identity (seed, stage, cell, source, detector, effect ...) is hashed into the key of a counter-based Philox
generator: equal identities give equal numbers on any core, in any order, after any retry; a new stage takes a new name
and leaves the numbers of the others as they were.

stream     a generator of one identity
name_of    its key, for a header
uniforms   a few numbers for each of many sources, whichever others they are drawn with
mixed      SplitMix64's mixer, of which numbers that are keyed one by one are made
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float, Int
from lake_schema.errors import BadInput

# SplitMix64's step.
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST, _SECOND = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31 = np.uint64(30), np.uint64(27), np.uint64(31)


def key_hex(*identity: int | str) -> str:
    """The key of an identity's generator as text: 32 hexadecimal digits, the first word of Philox's key first."""
    first, second = _key(identity)
    return f"{int(first):016x}{int(second):016x}"


def stream(*identity: int | str) -> np.random.Generator:
    """The generator of one identity, e.g. stream(seed, "galaxies.shape", cell).

    identity : integers and strings; 1 and "1" are different, and so are ("a", "b") and ("ab",)
    """
    return np.random.Generator(np.random.Philox(key=_key(identity)))


def uniforms(ids: Int, count: int, *identity: int | str) -> Float:
    """Random numbers in (0, 1), [count, n], each a function of the identity, the source and its place alone.

    ids : int64[n]
    Ref : Steele, Lea & Flood 2014 (SplitMix64: a counter through a mixer that changes half of the bits)
    """
    first, second = _key(identity)
    hashed_ids = mix_bits(ids.astype(np.uint64) ^ first)
    # Arithmetic is modulo 2^64.
    counters = (np.arange(count, dtype=np.uint64) + np.uint64(1)) * GOLDEN
    bits = mix_bits((hashed_ids[None, :] ^ second) + counters[:, None])
    # 52 bits and a half: neither 0 nor, rounded, 1.
    return np.asarray(((bits >> np.uint64(12)) + 0.5) * 2.0**-52)


def mix_bits(words: Any) -> Any:
    """uint64 words, each through a mixer that changes half of the bits.

    Arrays, or single ones where truesky.numerics.compiling compiles it (by that name this file is in the key of
    machine code).
    """
    words = (words ^ (words >> _S30)) * _FIRST
    words = (words ^ (words >> _S27)) * _SECOND
    return words ^ (words >> _S31)


def _key(identity: tuple[int | str, ...]) -> npt.NDArray[np.uint64]:
    for part in identity:
        if isinstance(part, bool) or not isinstance(part, (int, str, np.integer)):
            raise BadInput(f"a random stream is identified by integers and strings, not {part!r}")
    canonical = tuple(part if isinstance(part, str) else int(part) for part in identity)
    digest = hashlib.blake2b(repr(canonical).encode(), digest_size=16).digest()
    return np.frombuffer(digest, "<u8").copy()
