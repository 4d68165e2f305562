"""Validate the simulation: python -m truesky.validation [--lake LAKE ..] [--quick] [--json FILE] ..

With --lake LAKE the products of a lake are measured from its published files alone. The results are published as
the table `validation` with a report.html. The exit status is 1 if a figure fails that is not known to fail.

Without --lake the universe is drawn. Each figure with an expectation in expectations.csv or an observation in
observed.csv is printed with its verdict: pass, fail, or undecided if the expected number is quoted from memory. The
exit status is 1 if a figure fails without a reason in the column known_to_fail. results.json contains the figures of
the last full run.
"""

from __future__ import annotations

import argparse
import math
import os
import shutil
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

# Set the number of threads before any import of numpy, because numpy reads this variable only once.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from lake_schema import command, user_files
from lake_schema.errors import BadInput
from lake_schema.store import layout, manifest, provenance
from truesky.validation import checks
from truesky.validation.lake.suite import publishing
from truesky.validation.model import universe
from truesky.validation.verdicts import FAIL, UNDECIDED


def main(argv: Sequence[str] | None = None) -> int:
    """Run the validation of a lake or of the simulated universe, and return the exit status.

    The status is 0 for success, 1 if a check fails that is not known to fail or a file cannot be read or written, and 2
    for wrong arguments. `argv` are the arguments of the command; None means the arguments of the process.
    """
    parser = argparse.ArgumentParser(
        prog="python -m truesky.validation",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--lake", metavar="LAKE", help="validate the products of this lake")
    parser.add_argument("--name", help="request whose tables are validated, if the lake contains several")
    parser.add_argument("--exposures", nargs="+", type=int, default=[], metavar="ID", help="default: all exposures")
    parser.add_argument("--report", type=Path, metavar="FILE", help="also copy the report of the lake to this file")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, metavar="N", help="default: all cores")
    parser.add_argument(
        "--quick", action="store_true", help="draw a few small blocks and one box: takes 20 s, too little sky to pass"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures of the universe to this file")
    parser.add_argument("--figures", type=Path, metavar="FOLDER", help="write plots of the universe to this folder")
    options = parser.parse_args(argv)
    return command.run("validation", lambda: _validate(options))


def _validate(options: argparse.Namespace) -> int:
    if options.lake is not None:
        return _validate_lake(options)
    for name in ("name", "exposures", "report"):
        if getattr(options, name):
            raise BadInput(f"--{name} requires --lake")
    # Check that the output files can be written before the computation, which takes a quarter of an hour.
    if options.json is not None:
        user_files.check_target(options.json)
    if options.figures is not None:
        user_files.check_folder(options.figures)
    figures = universe.run(universe.QUICK if options.quick else universe.FULL, options.figures)
    results = checks.evaluate(figures)
    failed = checks.report(figures, results)
    if options.json is not None:
        metadata = {
            "name": "validation",
            "commit": provenance.git_commit(),
            "machine": provenance.machine(),
            "repeats": 1,
        }
        summary = {"checks": len(results), "failed": ", ".join(failed), "load_average": round(os.getloadavg()[0], 2)}
        values = {name: float(value) if math.isfinite(value) else None for name, value in figures.items()}
        manifest.write_json(options.json, {**metadata, **summary, **values})
    return int(any(check.is_unexpected_failure for check in results))


def _validate_lake(options: argparse.Namespace) -> int:
    """Validate the tables and images of a lake, print failed and undecided checks and the path of the report.

    Returns the exit status: 1 if a check fails that is not known to fail, otherwise 0. Wrong options raise BadInput.
    """
    for name in ("json", "figures", "quick"):
        if getattr(options, name):
            raise BadInput(f"--{name}: must not be used with --lake; the table and the report contain all results")
    if options.processes < 1:
        raise BadInput(f"--processes: must be at least 1, got {options.processes}")
    if options.report is not None:
        user_files.check_target(options.report)
    version = publishing.publish(layout.resolve_lake(options.lake), options.name, options.exposures, options.processes)
    rows = version.rows().to_pylist()
    for row in sorted(rows, key=lambda row: row["verdict"]):
        if row["verdict"] in (FAIL, UNDECIDED):
            label = f"{row['verdict']:10} {row['place']:40} {row['check_name']} {row['quantity']}"
            if row["value"] is None or row["error"] is None:
                print(f"{label}: {row['note']}")
                continue
            bound = f"{row['kind']} {row['expected']:.4g}, tolerance {row['tolerance']:.3g}"
            known_failure = f", known to fail: {row['known']}" if row["known"] else ""
            print(f"{label}: {row['value']:.4g} +- {row['error']:.2g} {row['value_unit']} ({bound}){known_failure}")
    verdict_counts = Counter(row["verdict"] for row in rows)
    print(", ".join(f"{number} {verdict.replace('_', ' ')}" for verdict, number in sorted(verdict_counts.items())))
    report = version.sidecar_path(publishing.REPORT)
    if options.report is not None:
        shutil.copyfile(report, options.report)
    print(options.report or report)
    return int(any(row["verdict"] == FAIL and not row["known"] for row in rows))


if __name__ == "__main__":
    command.exit_with_status(main)
