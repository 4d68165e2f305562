"""Query the tables of a lake (a folder of the simulator) with SQL on the command line.

Usage: python -m truesky.explore "SELECT ..." --lake LAKE [--name REQUEST] [--out FILE]. The name of FILE ends in .csv,
.parquet, .fits or .vot. Without --out the rows are printed, at most 40 of them. Without SQL the tables are listed.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from lake_schema import __version__, command, user_files
from lake_schema.store import layout
from truesky.explore import results
from truesky.explore.explorer import Explorer
from truesky.explore.process import MEMORY, TIMEOUT

_GIGABYTE = 1e9
_MAX_ROWS_SHOWN = 40


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status: 0 on success, 1 if the lake is damaged, 2 for wrong input.

    The status is also 1 if a file cannot be written.

    `argv` contains the command-line arguments without the name of the program; None means those of this process.
    """
    options = _options(argv)
    return command.run("explore", lambda: _answer(options))


def _answer(options: argparse.Namespace) -> int:
    if options.out is not None:
        user_files.check_target(options.out, results.ENDINGS)
    with Explorer(
        layout.open_lake(options.lake, options.endpoint_url), options.memory * _GIGABYTE, options.timeout, options.name
    ) as lake:
        if options.sql is None:
            print(lake.tables().to_string())
            return int(bool(lake.damaged))
        rows = lake.sql(options.sql, into="arrow")
    if options.out is None:
        print(results.convert(rows, "pandas").to_string(max_rows=_MAX_ROWS_SHOWN, index=False))
        print(f"{rows.num_rows:,} rows")
    else:
        results.write(rows, options.out)
        print(f"{options.out}: {rows.num_rows:,} rows, {options.out.stat().st_size / 1e6:.1f} MB")
    return 0


def _options(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m truesky.explore",
        description="Run one SELECT over the tables of a lake; without one, list the tables.",
        epilog=f"truesky {__version__}",
    )
    parser.add_argument("sql", nargs="?", help="a SELECT, in DuckDB's SQL")
    parser.add_argument("--lake", required=True, help="folder of the lake, or s3://BUCKET/PREFIX")
    parser.add_argument(
        "--endpoint-url", help="endpoint of the object storage (default: $AWS_ENDPOINT_URL, else Amazon S3)"
    )
    parser.add_argument("--name", help="request whose tables are queried, if the lake contains several")
    parser.add_argument("--out", type=Path, help="write to this .csv, .parquet, .fits or .vot file")
    limit = MEMORY / _GIGABYTE
    parser.add_argument(
        "--memory", type=float, default=limit, help=f"memory limit of the query in GB (default {limit:g})"
    )
    parser.add_argument(
        "--timeout", type=float, default=TIMEOUT, help=f"time limit of the query in s (default {TIMEOUT:g})"
    )
    return parser.parse_args(argv)


if __name__ == "__main__":
    command.exit_with_status(main)
