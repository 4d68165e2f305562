"""Random numbers keyed by what is drawn, never by where or when it runs.

A stream's identity (seed, stage, cell, source, detector, effect ...) is hashed into the key of a counter-based Philox
generator: equal identities give equal numbers on any core, in any order, after any retry; a new stage takes a new name
and leaves the numbers of the others as they were.
"""

from __future__ import annotations

import hashlib

import numpy as np

from lake_schema.errors import BadInput


def stream(*identity: int | str) -> np.random.Generator:
    """The generator of one identity, e.g. stream(seed, "galaxies.shape", cell).

    identity : integers and strings; 1 and "1" are different, and so are ("a", "b") and ("ab",)
    """
    for part in identity:
        if isinstance(part, bool) or not isinstance(part, (int, str, np.integer)):
            raise BadInput(f"a random stream is identified by integers and strings, not {part!r}")
    canonical = tuple(part if isinstance(part, str) else int(part) for part in identity)
    digest = hashlib.blake2b(repr(canonical).encode(), digest_size=16).digest()
    return np.random.Generator(np.random.Philox(key=np.frombuffer(digest, "<u8").copy()))
