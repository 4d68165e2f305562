"""What a part took, beside its receipt: seconds, those of the processor, its largest memory; bytes of its files."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lake_schema.store.plan import Json, Task

# Linux: a 5 written here makes the process's largest memory start again from what it holds now.
_CLEAR, _RESET, _STATUS = Path("/proc/self/clear_refs"), "5", Path("/proc/self/status")


class WithMetrics:
    """A part's function with the clocks and the memory beside its receipt; crosses to the workers."""

    def __init__(self, run_task: Callable[[Task], Json]) -> None:
        self.run_task = run_task

    def __call__(self, task: Task) -> dict[str, Any]:
        reset_peak_memory()
        start, cpu_start = time.perf_counter(), time.process_time()
        receipt = self.run_task(task)
        metrics: dict[str, Any] = {
            "seconds": time.perf_counter() - start,
            "cpu_s": time.process_time() - cpu_start,
            "peak_gb": peak_memory_gb(),
        }
        if "files" in receipt:
            metrics["bytes"] = sum(file["bytes"] for file in receipt["files"])
        return {**receipt, **metrics}


def reset_peak_memory() -> None:
    """Begin to measure the peak anew, where the system can."""
    try:
        _CLEAR.write_text(_RESET)
    except OSError:
        return


def peak_memory_gb() -> float:
    """Largest resident memory since `forget_peak`, GB; of the process's life where the system cannot begin anew."""
    try:
        line = next(line for line in _STATUS.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(line.split()[1]) * 1024 / 1e9
    except (OSError, StopIteration, ValueError):
        # In kilobytes on Linux, in bytes on macOS.
        unit = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9
