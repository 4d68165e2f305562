"""How fast this machine is against that of the channels' costs: the factor of a forecast's seconds.

Speed        the factor, and what it was learnt from
of_machine   from the detectors that the lake holds, else from a calibration of a second, kept in the cache
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import scipy.fft

from lake_schema.arrays import Float
from lake_schema.errors import LakeError
from lake_schema.store import read
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.store.provenance import machine
from truesky.numerics import cache
from truesky.numerics.code_keys import code_key
from truesky.render.products import run_log

# CPU s of a pass of `calibration` on the machine of the channels' costs: found on another (AMD EPYC, znver5), which
# takes 0.13 s for it, and for detectors 0.4 to 0.57 of what they say.
REFERENCE_S = 0.28
# Detectors that are enough to learn from: the first of each process compiles and computes what the others find.
_ENOUGH = 3
_REPEATS, _SIDE, _STAMPS, _NUMBERS = 5, 128, 192, 2_000_000


@dataclass(frozen=True, slots=True)
class Speed:
    """CPU s here over those of the forecast's machine; what it was learnt from, a clause."""

    factor: float
    source: str


def of_machine(lake: Folder) -> Speed:
    """Of the machine that this process runs on.

    Error : of the calibration, 30 % of a detector's seconds
    """
    measured = list(_measured(lake))
    if len(measured) >= _ENOUGH:
        return Speed(float(np.median(measured)), f"learnt from {len(measured)} detectors that this lake holds")
    key = cache.content_key(code_key(__name__), machine())
    kept = cache.cached_arrays("calibration", key, lambda: {"seconds": calibration()})
    return Speed(float(kept["seconds"].min()) / REFERENCE_S, "from a calibration of a second")


def calibration() -> Float:
    """CPU s [repeats] of what detectors are made of: transforms of stamps, exponentials, random numbers, a sort."""
    rng = np.random.default_rng(1)
    waves = (rng.normal(size=(_STAMPS, _SIDE, _SIDE // 2 + 1)) + 0j).astype(np.complex64)
    light, seconds = rng.uniform(0.0, 100.0, _NUMBERS), np.empty(_REPEATS)
    for i in range(_REPEATS):
        started = time.process_time()
        for _ in range(4):
            scipy.fft.irfft2(waves, s=(_SIDE, _SIDE))
        np.sort(np.exp(-0.01 * light) + rng.poisson(light))
        seconds[i] = time.process_time() - started
    return seconds


def _measured(lake: Folder) -> Iterator[float]:
    """CPU s over the forecast's of every detector of the current products that a machine of this kind rendered."""
    try:
        version = read.published_last(lake, "products")
        parts = {part["name"]: part["facts"] for part in version.manifest["parts"]}
        numbers = {facts["exposure_id"] for facts in parts.values()}
        planned = read.version(lake, "tasks", version.manifest["facts"]["inputs"]["tasks"])
        rendered = pc.field("exposure_id").isin(pa.array([*numbers], pa.int64()))
        # A part after the other: a plan may be larger than memory.
        each = (planned.rows(("exposure_id", "detector", "seconds"), [part], rendered) for part in planned.parts)
        foreseen = {(row["exposure_id"], row["detector"]): row["seconds"] for some in each for row in some.to_pylist()}
    except (LakeError, KeyError):
        return
    for line in _lines(lake, version.key):
        facts = parts.get(str(line.get("part", "")), {})
        place = facts.get("exposure_id"), facts.get("detector")
        took, mine = line.get("cpu_s"), line.get("machine") == machine()
        if mine and "error" not in line and isinstance(took, float) and 0 < took < math.inf and foreseen.get(place):
            yield took / foreseen[place]


def _lines(lake: Folder, key: str) -> Iterator[dict[str, Any]]:
    """What was written of the parts of a version of `products`; a log that cannot be read teaches nothing."""
    for path in run_log.of_products(lake):
        with contextlib.suppress(LakeError, OSError):
            first, *parts = run_log.lines(path) or [{}]
            if first.get("key") == key:
                yield from parts
