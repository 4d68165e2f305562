"""Estimate the speed of this machine relative to the machine of the channels' costs.

The result is a factor on the seconds of a forecast.
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

# CPU seconds of `run_calibration` on the machine of the channels' costs. It was derived on another machine (AMD EPYC,
# znver5), which takes 0.13 s, and 0.4 to 0.57 of the costs for detectors.
REFERENCE_S = 0.28
# Lowest number of detectors for an estimate. The first one of each process takes longer: it compiles functions and
# fills the cache.
_MIN_DETECTORS = 3
_REPEATS, _SIDE, _STAMPS, _NUMBERS = 5, 128, 192, 2_000_000


@dataclass(frozen=True, slots=True)
class Speed:
    """Speed of this machine.

    Attributes
    ----------
    factor : float
        CPU seconds on this machine relative to the machine of the forecast.
    source : str
        Origin of the factor, a clause.
    """

    factor: float
    source: str


def estimate_speed(lake: Folder) -> Speed:
    """Estimate the speed of the machine of this process.

    The factor is the median over the detectors that the lake contains. With too few detectors, it comes from a
    calibration of one second, which is stored in the cache; its error is 30 % of a detector's seconds.
    """
    ratios = list(_speed_ratios(lake))
    if len(ratios) >= _MIN_DETECTORS:
        return Speed(float(np.median(ratios)), f"estimated from {len(ratios)} detectors in this lake")
    key = cache.content_key(code_key(__name__), machine())
    stored = cache.cached_arrays("calibration", key, lambda: {"seconds": run_calibration()})
    return Speed(float(stored["seconds"].min()) / REFERENCE_S, "from a calibration of one second")


def run_calibration() -> Float:
    """Return the CPU seconds of a set of typical operations, per repeat.

    The operations are transforms of stamps, exponentials, random numbers and a sort.
    """
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
    """Yield the CPU time relative to the forecast, for each current detector that this kind of machine rendered."""
    try:
        version = read.latest_version(lake, "products")
        facts_of_task = {task["name"]: task["facts"] for task in version.manifest["parts"]}
        exposure_ids = {facts["exposure_id"] for facts in facts_of_task.values()}
        planned = read.version(lake, "tasks", version.manifest["facts"]["inputs"]["tasks"])
        rendered = pc.field("exposure_id").isin(pa.array([*exposure_ids], pa.int64()))
        # Read one partition after the other, because a plan may be larger than memory.
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
    """Yield the log lines for tasks of a version of `products`. Logs that cannot be read are skipped."""
    for path in run_log.logs_of_products(lake):
        with contextlib.suppress(LakeError, OSError):
            first, *task_lines = run_log.lines(path) or [{}]
            if first.get("key") == key:
                yield from task_lines
