"""Is what is simulated what it should be: python -m jobs.validation [--quick] [--json FILE] [--figures FOLDER].

Each figure that expectations.csv has an expectation of is printed with it and with PASS or FAIL.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path

# Before numpy is imported by anything.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from jobs.validation import checks, universe
from lake_schema.store import provenance


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m jobs.validation", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a few small blocks and no second box, for tests")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--figures", type=Path, metavar="FOLDER")
    options = parser.parse_args(argv)
    figures = universe.run(universe.QUICK if options.quick else universe.FULL, options.figures)
    results = checks.checks(figures)
    failed = checks.report(figures, results)
    if options.json:
        about = {
            "name": "validation",
            "commit": provenance.git_commit(),
            "machine": provenance.machine(),
            "repeats": 1,
        }
        summary = {"checks": len(results), "failed": ", ".join(failed), "load_average": round(os.getloadavg()[0], 2)}
        options.json.write_text(json.dumps({**about, **summary, **figures}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
