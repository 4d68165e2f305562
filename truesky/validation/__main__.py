"""Validate the simulation: the command `truesky validate [LAKE]`.

With LAKE the products of a lake are measured from its published files alone. The results are published as the table
`validation` with a report.html. The exit status is 1 if a figure fails that is not known to fail.

Without LAKE the universe is drawn. Each figure with an expectation in expectations.csv or an observation in
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
from typing import Any

# Set the number of threads before any import of numpy, because numpy reads this variable only once.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from lake_schema import command, user_files
from lake_schema.errors import BadInput
from lake_schema.store import layout, manifest, provenance
from lake_schema.texts import text_tables
from truesky.command_line import commands
from truesky.validation import checks
from truesky.validation.lake.suite import publishing
from truesky.validation.model import universe
from truesky.validation.verdicts import FAIL, NOT_APPLICABLE, UNDECIDED


def main(argv: Sequence[str] | None = None) -> int:
    """Run the validation of a lake or of the simulated universe, and return the exit status.

    The status is 0 for success, 1 if a check fails that is not known to fail or a file cannot be read or written, and 2
    for wrong arguments. `argv` are the arguments of the command; None means the arguments of the process.
    """
    return commands.run("validate", run_command, argv)


def run_command(options: argparse.Namespace) -> int:
    """Run `truesky validate` with its parsed arguments, and return the exit status.

    It is 1 if a check fails that is not known to fail, otherwise 0. Errors are raised as LakeError.
    """
    if options.lake is not None:
        return _validate_lake(options)
    for name in ("name", "exposures", "report"):
        if getattr(options, name):
            raise BadInput(f"--{name} requires LAKE")
    # Check that the output files can be written before the computation, which takes a quarter of an hour.
    if options.results is not None:
        user_files.check_target(options.results)
    if options.figures is not None:
        user_files.check_folder(options.figures)
    figures = universe.run(universe.QUICK if options.quick else universe.FULL, options.figures)
    results = checks.evaluate(figures)
    failed = [check.name for check in results if not check.passes]
    if options.json:
        verdicts = {check.name: check.verdict for check in results}
        rows = [{"figure": n, "value": float(value), "verdict": verdicts.get(n)} for n, value in figures.items()]
        text_tables.print_json(rows)
    else:
        checks.report(figures, results)
    if options.results is not None:
        metadata = {
            "name": "validation",
            "commit": provenance.git_commit(),
            "machine": provenance.machine(),
            "repeats": 1,
        }
        summary = {"checks": len(results), "failed": ", ".join(failed), "load_average": round(os.getloadavg()[0], 2)}
        values = {name: float(value) if math.isfinite(value) else None for name, value in figures.items()}
        manifest.write_json(options.results, {**metadata, **summary, **values})
    return int(any(check.is_unexpected_failure for check in results))


def _validate_lake(options: argparse.Namespace) -> int:
    """Validate the tables and images of a lake, print failed and undecided checks and the path of the report.

    Returns the exit status: 1 if a check fails that is not known to fail, otherwise 0. Wrong options raise BadInput.
    """
    for name in ("results", "figures", "quick"):
        if getattr(options, name):
            raise BadInput(f"--{name}: must not be used with LAKE; the table and the report contain all results")
    if options.processes < 1:
        raise BadInput(f"--processes: must be at least 1, got {options.processes}")
    if options.report is not None:
        user_files.check_target(options.report)
    version = publishing.publish(layout.resolve_lake(options.lake), options.name, options.exposures, options.processes)
    rows = version.rows().to_pylist()
    report = version.sidecar_path(publishing.REPORT)
    if options.report is not None:
        shutil.copyfile(report, options.report)
    if options.json:
        text_tables.print_json(rows)
    else:
        _print_rows(rows)
        print(options.report or report)
    return int(any(row["verdict"] == FAIL and not row["known"] for row in rows))


def _print_rows(rows: Sequence[dict[str, Any]]) -> None:
    """Print a line with the reason for each failed and undecided row, the reasons of skipped checks, and the counts."""
    for row in sorted(rows, key=lambda row: row["verdict"]):
        if row["verdict"] in (FAIL, UNDECIDED):
            known_failure = f"; known to fail: {row['known']}" if row["known"] else ""
            print(f"{row['verdict']:10} {row['place']:40} {row['check_name']} {row['quantity']}: ", end="")
            print(f"{_reason(row)}{known_failure}")
    skipped = Counter((row["check_name"], row["note"]) for row in rows if row["verdict"] == NOT_APPLICABLE)
    for (name, note), number in sorted(skipped.items()):
        print(f"{'skipped':10} {f'{number} figure' + 's' * (number > 1):40} {name}: {note}")
    verdict_counts = Counter(row["verdict"] for row in rows)
    print(", ".join(f"{number} {verdict.replace('_', ' ')}" for verdict, number in sorted(verdict_counts.items())))


def _reason(row: dict[str, Any]) -> str:
    """Return why a row failed or is undecided: the value, the expected value, the cause, and the sample."""
    if row["value"] is None:
        return row["note"] or "nothing could be measured"
    unit = f" {row['value_unit']}" if row["value_unit"] else ""
    bound = f"{row['kind']} {row['expected']:.4g}, tolerance {row['tolerance']:.3g}"
    if row["error"] is None:
        cause, value = "its error is unknown", f"{row['value']:.4g}{unit}"
    else:
        failed = row["verdict"] == FAIL
        cause = "beyond the tolerance by more than 3 errors" if failed else "the error is too large for a decision"
        value = f"{row['value']:.4g} +- {row['error']:.2g}{unit}"
    return "; ".join(filter(None, (f"{value} ({bound})", cause, row["note"])))


if __name__ == "__main__":
    command.exit_with_status(main)
