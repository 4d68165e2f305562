"""Is what is simulated what it should be: python -m jobs.validation [--quick | --lake LAKE] [--json FILE] ...

Each figure that expectations.csv has an expectation of, or observed.csv an observation, is printed with it and with
PASS or FAIL; near or far, where the number is remembered and gates nothing. The exit status is 1 where one fails that
its column known_to_fail gives no reason for. results.json holds the figures of the last full run.

--lake  the galaxies of a lake beside what was observed, in place of everything else
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path

# Before numpy is imported by anything.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from jobs.validation import checks, observed, universe
from lake_schema import command, user_files
from lake_schema.store import manifest, provenance


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status: 0, 1 a check fails that is not known to fail or the disc refuses, 2 the call is wrong."""
    parser = argparse.ArgumentParser(prog="python -m jobs.validation", description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--quick", action="store_true", help="a few small blocks and no second box: 20 s, and too little sky to pass"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to this file")
    parser.add_argument("--lake", type=Path, metavar="LAKE", help="compare the galaxies of this lake with observations")
    parser.add_argument("--name", help="of the request whose galaxies are taken, where a lake has several")
    parser.add_argument("--figures", type=Path, metavar="FOLDER", help="draw them into this folder")
    options = parser.parse_args(argv)
    return command.status("validation", lambda: _validated(options))


def _validated(options: argparse.Namespace) -> int:
    # What is computed takes a quarter of an hour: where it is to go is looked at before.
    if options.json is not None:
        user_files.target(options.json)
    if options.figures is not None:
        user_files.folder(options.figures)
    if options.lake is not None:
        figures = observed.figures(observed.in_lake(options.lake, options.name))
    else:
        figures = universe.run(universe.QUICK if options.quick else universe.FULL, options.figures)
    results = checks.checks(figures)
    failed = checks.report(figures, results)
    if options.json is not None:
        about = {"name": "validation", "commit": provenance.git_commit(), "machine": provenance.machine(), "repeats": 1}
        summary = {"checks": len(results), "failed": ", ".join(failed), "load_average": round(os.getloadavg()[0], 2)}
        found = {name: float(value) if math.isfinite(value) else None for name, value in figures.items()}
        manifest.write_json(options.json, {**about, **summary, **found})
    return int(any(check.unexpected for check in results))


if __name__ == "__main__":
    sys.exit(main())
