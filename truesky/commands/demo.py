"""Simulate a small field on one machine: run all jobs of the example request `demo`, with all results in one folder.

Usage: python -m truesky.commands.demo [--request requests/demo.toml] [--out out/demo]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from lake_schema import __version__, command
from lake_schema.store import layout
from truesky.commands import examples, run, submit
from truesky.request.from_toml import parse


def main(argv: list[str] | None = None) -> int:
    """Run the demo with the given arguments (by default sys.argv), and return the exit status.

    It is 0, that of the first job that fails, or 2 for a wrong request. After Ctrl-C or SIGTERM the process ends with
    status 130 or 143.
    """
    parser = argparse.ArgumentParser(
        prog="python -m truesky.commands.demo",
        description="Simulate a small field: run five jobs, print a table and draw pictures.",
        epilog=f"truesky {__version__}",
    )
    parser.add_argument("--request", type=Path, default=examples.request_file("demo"), help="simulation request")
    parser.add_argument("--out", default="out/demo", help="folder of the lake and the pictures")
    options = parser.parse_args(argv)

    def run_demo() -> int:
        out, request = layout.resolve_lake(options.out), parse(options.request)
        return run.run(
            layout.resolve_lake(out / "lake"), options.request, run.stages(request), request, submit.submit, out
        )

    with submit.stop_on_signal("demo"):
        return command.run("demo", run_demo)


if __name__ == "__main__":
    command.exit_with_status(main)
