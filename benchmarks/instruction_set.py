"""CPU time with the common instruction set over the time with all instructions of this CPU.

Two processes per subject, one with TRUESKY_CPU=portable and one with TRUESKY_CPU=native, do the same work in turn, so
that a change of the machine's speed affects both. Each does the work once before it is measured. On a CPU without
AVX-512 the ratios are 1.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

# Before numpy is imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import lake_schema  # noqa: F401
from benchmarks import report
from lake_schema import instruction_set

SETTINGS = (instruction_set.PORTABLE, instruction_set.NATIVE)
_GALAXIES, _GENERATION_CELLS = 200_000, 4
_NOTES = {
    "vis_ratio": "a VIS detector at survey accuracy with all effects, from the catalogue to the file",
    "nisp_s_ratio": "a NISP-S detector, the same",
    "fluxes_ratio": f"{_GALAXIES:,} galaxies in 22 bands from tables",
    "catalogue_ratio": "halos and galaxies of a sixteenth of an order-5 cell",
}


# A subject imports what it needs, since a process for another subject would load it for seconds.
def _vis(folder: Path, quick: bool) -> Callable[[], Any]:
    from benchmarks import _detectors, vis

    plain = vis.request(quick)
    root = _detectors.lake(folder, plain)
    facts = _detectors.prepared(root, vis.full(plain))
    return lambda: _detectors.rendered(root, facts, folder)


def _nisp_s(folder: Path, quick: bool) -> Callable[[], Any]:
    from benchmarks import _detectors, nisp_s
    from truesky.request.from_toml import parse

    file = folder / "request.toml"
    file.write_text(nisp_s.request(quick), encoding="utf-8")
    plain = parse(file)
    root = _detectors.lake(folder, plain)
    facts = _detectors.prepared(root, nisp_s.full(plain))
    return lambda: _detectors.rendered(root, facts, folder)


def _fluxes(folder: Path, quick: bool) -> Callable[[], Any]:
    from benchmarks import fluxes
    from truesky.fluxes.libraries import templates
    from truesky.fluxes.sources import galaxies_of
    from truesky.request.accuracy import SURVEY

    library = templates.galaxy_library()
    rows = galaxies_of(fluxes.sample(1000 if quick else _GALAXIES, 3), library)
    return lambda: fluxes._interpolated(rows, library, SURVEY)


def _catalogue(folder: Path, quick: bool) -> Callable[[], Any]:
    from benchmarks import catalogue

    about = catalogue.facts(quick=True)
    return lambda: catalogue.make(catalogue.CELL, 1 if quick else _GENERATION_CELLS, about)


SUBJECTS = {"vis": _vis, "nisp_s": _nisp_s, "fluxes": _fluxes, "catalogue": _catalogue}


def serve(subject: str, quick: bool) -> None:
    """Do a subject's work once for each line on stdin and answer with its CPU seconds."""
    with tempfile.TemporaryDirectory() as folder:
        work = SUBJECTS[subject](Path(folder), quick)
        work()
        for _ in sys.stdin:
            started = time.process_time()
            work()
            print(f"seconds {time.process_time() - started}", flush=True)


def compare(subject: str, repeats: int, quick: bool) -> dict[str, float]:
    """Ratio of the CPU times, and the median time with each setting, in seconds.

    Parameters
    ----------
    subject : str
        A key of `SUBJECTS`.
    repeats : int
        Number of measurements of each setting.
    quick : bool
        Do little work, for tests.

    Returns
    -------
    dict of str to float
        `<subject>_ratio`, the median of the ratios of neighbouring measurements; its smallest and largest value; and
        `<subject>_portable_s`, `<subject>_native_s`.
    """
    command = [sys.executable, "-m", "benchmarks.instruction_set", "--serve", subject, *["--quick"] * quick]
    unset = {
        name: os.environ[name]
        for name in os.environ
        if not name.startswith(("NPY_", "NUMBA_CPU", "NUMBA_DISABLE", "ARROW_USER"))
    }
    with ExitStack() as stack:
        children = {
            setting: stack.enter_context(
                subprocess.Popen(
                    command, env={**unset, instruction_set.SETTING: setting}, text=True,
                    stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                )
            )
            for setting in SETTINGS
        }  # fmt: skip
        seconds: dict[str, list[float]] = {setting: [] for setting in SETTINGS}
        for number in range(repeats):
            for setting in SETTINGS[:: 1 if number % 2 else -1]:
                seconds[setting].append(_ask(children[setting]))
        for child in children.values():
            child.communicate()
    ratios = [ours / all_of_them for ours, all_of_them in zip(*seconds.values(), strict=True)]
    return {
        f"{subject}_ratio": statistics.median(ratios),
        f"{subject}_ratio_min": min(ratios),
        f"{subject}_ratio_max": max(ratios),
        **{f"{subject}_{setting}_s": statistics.median(values) for setting, values in seconds.items()},
    }


def _ask(child: subprocess.Popen[str]) -> float:
    assert child.stdin is not None
    assert child.stdout is not None
    child.stdin.write("\n")
    child.stdin.flush()
    while line := child.stdout.readline():
        if line.startswith("seconds "):
            return float(line.split()[1])
    raise SystemExit(f"benchmarks.instruction_set: a process ended with status {child.wait()}")


def main(argv: Sequence[str] | None = None) -> int:
    """Measure the subjects and print the ratios."""
    own = argparse.ArgumentParser(add_help=False)
    own.add_argument("--subjects", nargs="+", choices=SUBJECTS, default=list(SUBJECTS))
    own.add_argument("--repeats", type=int, default=7, help="of each measurement")
    own.add_argument("--serve", choices=SUBJECTS, help=argparse.SUPPRESS)
    known, others = own.parse_known_args(argv)
    options = report.options("instruction_set", __doc__ or "", others)
    if known.serve:
        serve(known.serve, options.quick)
        return 0
    repeats = 1 if options.quick else known.repeats
    figures: dict[str, float] = {}
    for subject in known.subjects:
        figures |= compare(subject, repeats, options.quick)
    report.finish("instruction_set", repeats, figures, _NOTES, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
