"""Command that queries the database of telescope and camera parameters, and writes the folder of a new camera.

It is python -m lake_schema mission list [PATTERN] | diff A [B] | camera FOLDER. A and B name a configuration (one value
per parameter): by statuses in order of preference (CBE,BLT,DES,REQ,SIM), by a request file, or by a lake with a table
`mission`, as LAKE or LAKE@KEY, where KEY selects a version of the table.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from lake_schema import command
from lake_schema.mission import camera_template, compare, listing
from lake_schema.mission.parameter import CAMERAS
from lake_schema.tables.mission import LADDER

_DEFAULT_LADDER = ",".join(LADDER)
_CONFIGURATION_HELP = "a ladder (CBE,BLT,DES,REQ,SIM), a request file, or LAKE or LAKE@KEY with a table mission"


def main(argv: Sequence[str]) -> int:
    """Run the command `mission` with the arguments `argv`, and return its exit status.

    The status is 0 for success, 1 for a damaged lake, and 2 for wrong arguments. For `diff`, it is 1 if the
    configurations differ.
    """
    parser = argparse.ArgumentParser(prog="python -m lake_schema mission", description="Query the mission database.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="list|diff|camera")
    list_parser = commands.add_parser("list", help="names, values, units, bounds, status and source")
    list_parser.add_argument(
        "pattern", nargs="?", default="*", help="pattern of names, such as vis.* or *gain*; without *, a substring"
    )
    list_parser.add_argument(
        "--of", default=_DEFAULT_LADDER, metavar="WHAT", help=f"{_CONFIGURATION_HELP} (default: {_DEFAULT_LADDER})"
    )
    list_parser.add_argument("--json", action="store_true", help="print a JSON list of objects")
    diff_parser = commands.add_parser("diff", help="differences between two configurations")
    diff_parser.add_argument("first", help=_CONFIGURATION_HELP)
    diff_parser.add_argument(
        "second", nargs="?", default=_DEFAULT_LADDER, help=f"second configuration (default: {_DEFAULT_LADDER})"
    )
    camera_parser = commands.add_parser("camera", help="write the folder of a ground camera, to be edited")
    camera_parser.add_argument("folder", type=Path, help="folder to create; its name is the camera's name")
    camera_parser.add_argument("--like", required=True, choices=CAMERAS, help="camera whose numbers are copied")
    options = parser.parse_args(argv)
    run_command = {"list": _list_entries, "diff": _print_differences, "camera": _write_camera}[options.command]
    return command.run("lake_schema", lambda: run_command(options))


def _list_entries(options: argparse.Namespace) -> int:
    entries = listing.list_entries(compare.load_configuration(options.of), options.pattern)
    if options.json:
        print(json.dumps([asdict(entry) for entry in entries], indent=1))
        return 0
    for line in listing.align_columns(entries):
        print(line)
    return 0


def _write_camera(options: argparse.Namespace) -> int:
    for path in camera_template.write_like(options.like, options.folder):
        print(path)
    return 0


def _print_differences(options: argparse.Namespace) -> int:
    lines = compare.compare_configurations(options.first, options.second)
    for line in lines:
        print(line)
    return int(bool(lines))
