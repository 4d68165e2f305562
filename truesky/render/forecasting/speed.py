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
from truesky.numerics.code_fingerprints import code_key
from truesky.render.products import run_log

# CPU s of a pass of `calibration` on the machine of the channels' costs: found on another (AMD EPYC, znver5), which
# takes 0.13 s for it, and for detectors 0.4 to 0.57 of what they say.
REFERENCE_S = 0.28
# Detectors that are enough to learn from: the first of each process compiles and computes what the others find.
_MIN_DETECTORS = 3
_REPEATS, _SIDE, _STAMPS, _NUMBERS = 5, 128, 192, 2_000_000


@dataclass(frozen=True, slots=True)
class Speed:
    """CPU s here over those of the forecast's machine; what it was learnt from, a clause."""

    factor: float
    source: str


def estimate_speed(lake: Folder) -> Speed:
    """Of the machine that this process runs on.

    Error : of the calibration, 30 % of a detector's seconds
    """
    ratios = list(_speed_ratios(lake))
    if len(ratios) >= _MIN_DETECTORS:
        return Speed(float(np.median(ratios)), f"learnt from {len(ratios)} detectors that this lake holds")
    key = cache.content_key(code_key(__name__), machine())
    stored = cache.cached_arrays("calibration", key, lambda: {"seconds": run_calibration()})
    return Speed(float(stored["seconds"].min()) / REFERENCE_S, "from a calibration of a second")


def run_calibration() -> Float:
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


def _speed_ratios(lake: Folder) -> Iterator[float]:
    """CPU s over the forecast's of every detector of the current products that a machine of this kind rendered."""
    try:
        version = read.latest_version(lake, "products")
        facts_of_task = {task["name"]: task["facts"] for task in version.manifest["parts"]}
        exposure_ids = {facts["exposure_id"] for facts in facts_of_task.values()}
        planned = read.version(lake, "tasks", version.manifest["facts"]["inputs"]["tasks"])
        rendered = pc.field("exposure_id").isin(pa.array([*exposure_ids], pa.int64()))
        # A part after the other: a plan may be larger than memory.
        task_tables = (
            planned.rows(("exposure_id", "detector", "seconds"), [partition], rendered)
            for partition in planned.partitions
        )
        forecast_s = {
            (row["exposure_id"], row["detector"]): row["seconds"] for table in task_tables for row in table.to_pylist()
        }
    except (LakeError, KeyError):
        return
    for line in _log_lines(lake, version.key):
        facts = facts_of_task.get(str(line.get("part", "")), {})
        key = facts.get("exposure_id"), facts.get("detector")
        cpu_s, is_this_machine = line.get("cpu_s"), line.get("machine") == machine()
        if (
            is_this_machine
            and "error" not in line
            and isinstance(cpu_s, float)
            and 0 < cpu_s < math.inf
            and forecast_s.get(key)
        ):
            yield cpu_s / forecast_s[key]


def _log_lines(lake: Folder, key: str) -> Iterator[dict[str, Any]]:
    """What was written of the parts of a version of `products`; a log that cannot be read teaches nothing."""
    for path in run_log.logs_of_products(lake):
        with contextlib.suppress(LakeError, OSError):
            first, *task_lines = run_log.lines(path) or [{}]
            if first.get("key") == key:
                yield from task_lines
