"""Compare the CPU time with instructions that all common CPUs have, and with all instructions of this CPU.

For each kind of work there are two processes, one with TRUESKY_CPU=portable and one with TRUESKY_CPU=native. They do
the same work in turn, so that a change of the machine's speed affects both. Each does the work once before the first
measurement. On a CPU without AVX-512 the ratios are about 1.
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

# The number of threads must be set before NumPy is imported, because NumPy reads OMP_NUM_THREADS only then.
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


# Each function below prepares one kind of work and returns a function that does it. They import what they need
# themselves, because loading the modules of all kinds of work would take seconds.
def _vis(folder: Path, quick: bool) -> Callable[[], Any]:
    from benchmarks import _detectors, vis

    plain = vis.demo_request(quick)
    root = _detectors.make_lake(folder, plain)
    facts = _detectors.plan_detector(root, vis.with_all_effects(plain))
    return lambda: _detectors.measure_render(root, facts, folder)


def _nisp_s(folder: Path, quick: bool) -> Callable[[], Any]:
    from benchmarks import _detectors, nisp_s
    from truesky.request.from_toml import parse

    file = folder / "request.toml"
    file.write_text(nisp_s.request_text(quick), encoding="utf-8")
    plain = parse(file)
    root = _detectors.make_lake(folder, plain)
    facts = _detectors.plan_detector(root, nisp_s.with_all_effects(plain))
    return lambda: _detectors.measure_render(root, facts, folder)


def _fluxes(folder: Path, quick: bool) -> Callable[[], Any]:
    from benchmarks import fluxes
    from truesky.fluxes.libraries import templates
    from truesky.fluxes.sources import galaxies_from_table
    from truesky.request.accuracy import SURVEY

    library = templates.galaxy_library()
    rows = galaxies_from_table(fluxes.sample(1000 if quick else _GALAXIES, 3), library)
    return lambda: fluxes._interpolate(rows, library, SURVEY)


def _catalogue(folder: Path, quick: bool) -> Callable[[], Any]:
    from benchmarks import catalogue

    settings = catalogue.universe_settings(quick=True)
    return lambda: catalogue.make_cell(catalogue.CELL, 1 if quick else _GENERATION_CELLS, settings)


SUBJECTS = {"vis": _vis, "nisp_s": _nisp_s, "fluxes": _fluxes, "catalogue": _catalogue}


def serve(subject: str, quick: bool) -> None:
    """Do one kind of work once for each line on stdin, and print the CPU time in s after each.

    `subject` is a key of SUBJECTS. The work is also done once before the first line, without a measurement.
    """
    with tempfile.TemporaryDirectory() as folder:
        run_subject = SUBJECTS[subject](Path(folder), quick)
        run_subject()
        for _ in sys.stdin:
            started = time.process_time()
            run_subject()
            print(f"seconds {time.process_time() - started}", flush=True)


def compare(subject: str, repeats: int, quick: bool) -> dict[str, float]:
    """Compare the CPU times of one kind of work with the common instructions and with all instructions of this CPU.

    Parameters
    ----------
    subject : str
        Kind of work, a key of `SUBJECTS`.
    repeats : int
        Number of measurements with each set of instructions.
    quick : bool
        If True, do little work, for tests.

    Returns
    -------
    dict of str to float
        `<subject>_ratio` (median of time with common instructions / time with all instructions, each from two
        measurements one after the other), `<subject>_ratio_min` and `<subject>_ratio_max` (smallest and largest ratio),
        and `<subject>_portable_s` and `<subject>_native_s` (median CPU times in s).

    Notes
    -----
    SystemExit is raised if a process ends early.
    """
    command = [sys.executable, "-m", "benchmarks.instruction_set", "--serve", subject, *["--quick"] * quick]
    environment = {
        name: os.environ[name]
        for name in os.environ
        if not name.startswith(("NPY_", "NUMBA_CPU", "NUMBA_DISABLE", "ARROW_USER"))
    }
    with ExitStack() as stack:
        children = {
            setting: stack.enter_context(
                subprocess.Popen(
                    command, env={**environment, instruction_set.SETTING: setting}, text=True,
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
    ratios = [portable / native for portable, native in zip(*seconds.values(), strict=True)]
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
    """Run the benchmark with the options `argv` (default: the command line), print the ratios, return 0."""
    extra_parser = argparse.ArgumentParser(add_help=False)
    extra_parser.add_argument("--subjects", nargs="+", choices=SUBJECTS, default=list(SUBJECTS))
    extra_parser.add_argument("--repeats", type=int, default=7, help="repeats of each measurement")
    extra_parser.add_argument("--serve", choices=SUBJECTS, help=argparse.SUPPRESS)
    extra_options, other_arguments = extra_parser.parse_known_args(argv)
    options = report.options("instruction_set", __doc__ or "", other_arguments)
    if extra_options.serve:
        serve(extra_options.serve, options.quick)
        return 0
    repeats = 1 if options.quick else extra_options.repeats
    figures: dict[str, float] = {}
    for subject in extra_options.subjects:
        figures |= compare(subject, repeats, options.quick)
    report.print_and_write("instruction_set", repeats, figures, _NOTES, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
