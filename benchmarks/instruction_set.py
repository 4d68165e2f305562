"""Compare the CPU time with instructions that all common CPUs have, and with all instructions of this CPU.

For each kind of work there are two processes, one with TRUESKY_CPU=portable and one with TRUESKY_CPU=native. They do
the same work in turn, so that a change of the machine's speed affects both. Each does the work once before the first
measurement. On a CPU without AVX-512 the ratios are about 1.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
from collections.abc import Sequence
from contextlib import ExitStack

from benchmarks import _subjects, report
from lake_schema import instruction_set

SETTINGS = (instruction_set.PORTABLE, instruction_set.NATIVE)
SUBJECTS = ("vis", "nisp_s", "fluxes", "catalogue")
_NOTES = {f"{name}_ratio": _subjects.NOTES[name] for name in SUBJECTS}


def compare(subject: str, repeats: int, quick: bool) -> dict[str, float]:
    """Compare the CPU times of one kind of work with the common instructions and with all instructions of this CPU.

    Parameters
    ----------
    subject : str
        Kind of work, an entry of `SUBJECTS`.
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
    environment = {
        name: os.environ[name]
        for name in os.environ
        if not name.startswith(("NPY_", "NUMBA_CPU", "NUMBA_DISABLE", "ARROW_USER"))
    }
    with ExitStack() as stack:
        processes = [
            stack.enter_context(_subjects.start(subject, quick, {**environment, instruction_set.SETTING: setting}))
            for setting in SETTINGS
        ]
        seconds = dict(zip(SETTINGS, _subjects.alternate(processes, repeats), strict=True))
    return {
        **_subjects.summarize_ratios(subject, *seconds.values()),
        **{f"{subject}_{setting}_s": statistics.median(values) for setting, values in seconds.items()},
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark with the options `argv` (default: the command line), print the ratios, return 0."""
    extra_parser = argparse.ArgumentParser(add_help=False)
    extra_parser.add_argument("--subjects", nargs="+", choices=SUBJECTS, default=SUBJECTS)
    extra_parser.add_argument("--repeats", type=int, default=7, help="repeats of each measurement")
    extra_options, other_arguments = extra_parser.parse_known_args(argv)
    options = report.options("instruction_set", __doc__ or "", other_arguments)
    repeats = 1 if options.quick else extra_options.repeats
    if repeats < 1:
        extra_parser.error("--repeats must be at least 1")
    figures: dict[str, float] = {}
    for subject in extra_options.subjects:
        figures |= compare(subject, repeats, options.quick)
    report.print_and_write("instruction_set", repeats, figures, _NOTES, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
