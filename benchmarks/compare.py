"""Compare the CPU time of this working copy with that of an earlier commit, kind by kind of work.

For each kind of work there are two processes, which do the same work in turn, so that a change of the machine's speed
affects both. Both run the benchmarks of this working copy; one imports the package truesky of the earlier commit from a
temporary checkout. The programs use the same installed libraries and the same cache. A ratio below 1 means that this
working copy is faster.

The tool asv (airspeed velocity) has a similar command. It is not used, because it installs an environment of a gigabyte
for each commit, and because it compares the times of separate series, which changes of the machine's speed affect.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from benchmarks import _subjects, report
from benchmarks._detectors import ROOT

# File that a commit must have, because benchmarks import the library from it. Without it, Python would import the
# library of this working copy if that is installed, and compare this working copy with itself.
_LIBRARY = Path("truesky", "render", "__init__.py")
_DEFAULTS = ("vis", "nisp_p", "nisp_s", "lsst", "fluxes", "catalogue")


@contextmanager
def checkout(commit: str) -> Iterator[Path]:
    """Provide a folder with the files of a commit and the benchmarks of this working copy during a `with` block.

    SystemExit is raised if git does not know the commit, or if its library has another name than now.
    """
    git = shutil.which("git") or "git"
    with tempfile.TemporaryDirectory(prefix="truesky-base-") as name:
        folder = Path(name) / "base"
        command = [git, "-C", str(ROOT), "worktree", "add", "--detach", str(folder), commit]
        added = subprocess.run(command, capture_output=True, text=True, check=False)
        if added.returncode:
            raise SystemExit(f"benchmarks.compare: commit {commit}: {added.stderr.strip().splitlines()[-1]}")
        try:
            if not (folder / _LIBRARY).is_file():
                raise SystemExit(
                    f"benchmarks.compare: commit {commit}: it has no package truesky.render (the library had another "
                    "name then), which the benchmarks import: choose a later commit"
                )
            shutil.rmtree(folder / "benchmarks", ignore_errors=True)
            shutil.copytree(ROOT / "benchmarks", folder / "benchmarks")
            yield folder
        finally:
            subprocess.run([git, "-C", str(ROOT), "worktree", "remove", "--force", str(folder)], check=True)


def compare(subject: str, base: Path, repeats: int, quick: bool) -> dict[str, float]:
    """Compare the CPU times of one kind of work.

    Parameters
    ----------
    subject : str
        Kind of work, a key of `_subjects.SUBJECTS`.
    base : Path
        Folder with the files of the earlier commit.
    repeats : int
        Number of measurements of each commit.
    quick : bool
        If True, do little work.

    Returns
    -------
    dict of str to float
        `<subject>_ratio` (median of new time / old time, each from two measurements one after the other),
        `<subject>_ratio_min` and `<subject>_ratio_max` (smallest and largest ratio), and `<subject>_base_s` and
        `<subject>_s` (median CPU times in s).
    """
    with ExitStack() as stack:
        processes = [
            stack.enter_context(_subjects.start(subject, quick, {**os.environ, "PYTHONPATH": str(folder)}, folder))
            for folder in (ROOT, base)
        ]
        new, old = _subjects.alternate(processes, repeats)
    return {
        **_subjects.summarize_ratios(subject, new, old),
        f"{subject}_base_s": statistics.median(old),
        f"{subject}_s": statistics.median(new),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark with the options `argv` (default: the command line), print the ratios, return 0."""
    extra_parser = argparse.ArgumentParser(add_help=False)
    extra_parser.add_argument("base", help="commit with which this working copy is compared")
    extra_parser.add_argument("--subjects", nargs="+", choices=_subjects.SUBJECTS, default=_DEFAULTS)
    extra_parser.add_argument("--repeats", type=int, default=5, help="repeats of each measurement")
    extra_options, other_arguments = extra_parser.parse_known_args(argv)
    options = report.options("compare", __doc__ or "", other_arguments)
    repeats = 1 if options.quick else extra_options.repeats
    if repeats < 1:
        extra_parser.error("--repeats must be at least 1")
    figures: dict[str, float] = {}
    with checkout(extra_options.base) as base:
        for subject in extra_options.subjects:
            figures |= compare(subject, base, repeats, options.quick)
    notes = {f"{name}_ratio": note for name, note in _subjects.NOTES.items()}
    report.print_and_write("compare", repeats, figures, notes, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
