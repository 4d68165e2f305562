"""Simulate a small field on one machine: run all jobs of the example request `demo`, with all results in one folder.

Usage: python -m truesky.commands.demo [--request requests/demo.toml] [--out out/demo]
"""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from lake_schema import __version__, command, user_files
from lake_schema.store import layout
from truesky.commands import examples
from truesky.running import supervise


def main(argv: list[str] | None = None) -> int:
    """Run the demo with the given arguments (by default sys.argv), and return the exit status.

    It is 0, that of the first job that fails, or 2 for a wrong request. After Ctrl-C or SIGTERM it is 130 or 143.
    """
    parser = argparse.ArgumentParser(
        prog="python -m truesky.commands.demo",
        description="Simulate a small field: run five jobs, print a table and draw pictures.",
        epilog=f"truesky {__version__}",
    )
    parser.add_argument("--request", type=Path, default=examples.request_file("demo"), help="simulation request")
    parser.add_argument("--out", default="out/demo", help="folder of the lake and the pictures")
    options = parser.parse_args(argv)

    # Find wrong paths before the process of the run starts, because the system refuses some of them as arguments.
    if status := command.run("demo", lambda: _check_paths(options)):
        return status
    words = [str(options.request), "--lake", str(Path(options.out) / "lake"), "--pictures", options.out]
    resume = ["python", "-m", "truesky.commands.demo", "--request", str(options.request), "--out", options.out]
    return supervise.supervise("demo", ["-m", "truesky.commands.local_run", *words], shlex.join(resume))


def _check_paths(options: argparse.Namespace) -> int:
    """Return 0; raise BadInput if the lake cannot be a folder or the request is not a file."""
    layout.resolve_lake(options.out)
    user_files.check_file(options.request, "request")
    return 0


if __name__ == "__main__":
    command.exit_with_status(main)
