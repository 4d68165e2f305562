"""Estimate the speed of this machine relative to the reference machine.

Forecasts contain the CPU seconds of the reference machine (an Intel Xeon with 2.5 GHz), on which the costs of detector
images were measured. The result of this module is the factor by which they must be multiplied.
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

from lake_schema.arrays import Float
from lake_schema.errors import LakeError
from lake_schema.store import read
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.store.provenance import machine
from truesky.numerics import cache
from truesky.numerics.code_fingerprints import code_key
from truesky.render.products import run_log

# CPU seconds of `run_calibration` on the reference machine, for which all CPU times are forecast. The value was derived
# from another machine (AMD EPYC, znver5), which needs 0.13 s for `run_calibration`, and for an image 0.4 to 0.57 of the
# reference machine's time.
REFERENCE_S = 0.28
# Smallest number of rendered detector images from which the speed is estimated. It is above 1 because the first image
# of each process takes longer: functions are compiled and the disc cache is filled.
_MIN_DETECTORS = 3
# Number of times that `run_calibration` repeats its typical operations.
_REPEATS = 5
# Side in pixels of the stamps (small images) whose Fourier transforms `run_calibration` times.
_SIDE = 128
# Number of stamps (small images) to which `run_calibration` applies Fourier transforms.
_STAMPS = 192
# Number of random numbers that `run_calibration` draws and sorts.
_NUMBERS = 2_000_000


@dataclass(frozen=True, slots=True)
class Speed:
    """Speed of this machine.

    Attributes
    ----------
    factor : float
        CPU time of this machine divided by that of the reference machine, for which CPU times are forecast.
    source : str
        How the factor was found, as a clause for messages: "estimated from 5 detectors in this lake".
    """

    factor: float
    source: str


def estimate_speed(lake: Folder | None) -> Speed:
    """Estimate the speed of this machine. `lake` is None without a lake.

    The speed is a factor: the CPU time of this machine divided by that of the reference machine. If the lake (folder of
    stored tables and images) has at least three images that this kind of machine rendered, the factor is the median of
    their CPU time divided by its forecast. Otherwise it comes from a calibration of one second, whose result is kept in
    the disc cache. The forecast time of an image then has an error of 30 %.
    """
    ratios = [] if lake is None else list(_speed_ratios(lake))
    if len(ratios) >= _MIN_DETECTORS:
        return Speed(float(np.median(ratios)), f"estimated from {len(ratios)} detectors in this lake")
    key = cache.content_key(code_key(__name__), machine())
    stored = cache.cached_arrays("calibration", key, lambda: {"seconds": run_calibration()})
    return Speed(float(stored["seconds"].min()) / REFERENCE_S, "from a calibration of one second")


def run_calibration() -> Float:
    """Return the CPU seconds that a set of typical operations takes, shape (5,), one value per repetition.

    The operations are Fourier transforms of stamps, exponentials, Poisson numbers and a sort.
    """
    # Import here, because the import is slow, and not needed if the cache contains the result.
    import scipy.fft

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
    """Yield the CPU time divided by its forecast for each detector image that this kind of machine rendered.

    Only images of the latest version of the table `products` count. Nothing is yielded if the lake has no images.
    """
    try:
        version = read.latest_version(lake, "products")
        facts_of_task = {task["name"]: task["facts"] for task in version.manifest["parts"]}
        exposure_ids = {facts["exposure_id"] for facts in facts_of_task.values()}
        planned = read.version(lake, "tasks", version.manifest["facts"]["inputs"]["tasks"])
        rendered = pc.field("exposure_id").isin(pa.array([*exposure_ids], pa.int64()))
        # Read the table of planned detector images file by file: the whole table may be larger than the memory.
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
    """Yield the log lines, one per detector image, of the runs that made a version of the table `products`.

    `key` names the version. Logs that cannot be read are skipped.
    """
    for path in run_log.logs_of_products(lake):
        with contextlib.suppress(LakeError, OSError):
            first, *task_lines = run_log.lines(path) or [{}]
            if first.get("key") == key:
                yield from task_lines
