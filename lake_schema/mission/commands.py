"""Command that queries the database of telescope and camera parameters, and writes the folder of a new camera.

It is truesky mission list [PATTERN] | diff A [B] | camera FOLDER. A and B name a configuration (one value
per parameter): by statuses in order of preference (CBE,BLT,DES,REQ,SIM), by a request file, or by a lake with a table
`mission`, as LAKE or LAKE@KEY, where KEY selects a version of the table.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict

from lake_schema.mission import camera_template, compare, listing
from lake_schema.texts import text_tables


def run_command(options: argparse.Namespace) -> int:
    """Run the action in the parsed arguments of `truesky mission`, and return the exit status.

    The status is 0 for success, and 1 if `diff` finds a difference. BadInput is raised for wrong arguments.
    """
    run_action = {"list": _list_entries, "diff": _print_differences, "camera": _write_camera}[options.action]
    return run_action(options)


def _list_entries(options: argparse.Namespace) -> int:
    entries = listing.list_entries(compare.load_configuration(options.of), options.pattern)
    if options.json:
        text_tables.print_json([asdict(entry) for entry in entries])
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
