"""Query the tables of a lake (a folder of the simulator) with SQL: the command `truesky sql LAKE [QUERY]`.

Without --out or --json the rows are printed, at most 40 of them. Without QUERY the tables are listed.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from numbers import Integral
from typing import TYPE_CHECKING

from lake_schema import arguments, command, user_files
from lake_schema.errors import BadInput
from lake_schema.pandas_import import hide_pandas
from lake_schema.texts import text_tables
from truesky.command_line import commands

if TYPE_CHECKING:
    from truesky.explore.explorer import Explorer

_GIGABYTE = 1e9
# Limits of the option --memory, GB.
_GIGABYTES = (0.01, 1e6)
_MAX_ROWS_SHOWN = 40


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status: 0 on success, 1 if the lake is damaged, 2 for wrong input.

    The status is also 1 if a file cannot be written.

    `argv` contains the command-line arguments without the name of the program; None means those of this process.
    """
    return commands.run("sql", run_command, argv)


def run_command(options: argparse.Namespace) -> int:
    """Run `truesky sql` with its parsed arguments, and return the exit status.

    It is 0, or 1 if the tables are listed and some of them are damaged. Errors are raised as LakeError.
    """
    if options.sql is not None:
        if options.sql.strip().endswith(".sql") and " " not in options.sql.strip():
            raise BadInput(f'{options.sql}: the query must be SQL, not a file: truesky sql LAKE "$(cat {options.sql})"')
        hide_pandas()
    # These imports take long, and must come after `hide_pandas`.
    from lake_schema.store import layout
    from truesky.explore import results
    from truesky.explore.explorer import Explorer

    memory = arguments.check_number("--memory", options.memory, *_GIGABYTES) * _GIGABYTE
    if options.out is not None:
        user_files.check_target(options.out, results.ENDINGS)
        if options.json:
            raise BadInput("--json must not be used with --out, whose ending selects the format")
    with Explorer(layout.open_lake(options.lake, options.endpoint_url), memory, options.timeout, options.name) as lake:
        if options.sql is None:
            _print_tables(lake, options.json)
            return int(bool(lake.damaged))
        rows = lake.sql(options.sql, into="arrow")
    if options.out is not None:
        results.write(rows, options.out)
        print(f"{options.out}: {rows.num_rows:,} rows, {options.out.stat().st_size / 1e6:.1f} MB")
    elif options.json:
        text_tables.print_json(rows.to_pylist())
    else:
        names, lines = results.to_cells(rows, _MAX_ROWS_SHOWN)
        print(*text_tables.format_table(names, lines, names), sep="\n")
        print(f"{rows.num_rows:,} rows")
    return 0


def _print_tables(lake: Explorer, as_json: bool) -> None:
    frame = lake.tables().reset_index()
    if as_json:
        text_tables.print_json(frame.astype(object).where(frame.notna(), None).to_dict("records"))
        return
    rows = [[_table_cell(value) for value in row] for row in frame.itertuples(index=False)]
    for line in text_tables.format_table([*frame.columns], rows, {"rows", "MB", "files"}):
        print(line)


def _table_cell(value: object) -> str:
    if isinstance(value, float):
        return "-" if value != value else f"{value:,.1f}"
    return f"{value:,}" if isinstance(value, Integral) else "-" if str(value) == "<NA>" else str(value)


if __name__ == "__main__":
    command.exit_with_status(main)
