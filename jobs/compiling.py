"""numba, with its machine code in the project's cache: compiled once a machine, not once a process."""

from __future__ import annotations

import os
from typing import Any

from jobs import cache

# numba reads this when it is imported.
os.environ.setdefault("NUMBA_CACHE_DIR", str(cache.cache_dir() / "numba"))

import numba

# Sums may be taken in any order, which makes them twice as fast; NaN and infinity keep their meaning.
jit: Any = numba.njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
