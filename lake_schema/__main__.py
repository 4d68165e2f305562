"""Inspect and clean up a lake: python -m lake_schema list|verify|gc|describe LAKE [TABLE].

`tables` prints the reference page of all tables. `mission list [PATTERN]` prints the mission database, and `mission
diff A [B]` compares two of its configurations.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from lake_schema import __version__, command, listing, tables
from lake_schema.errors import BadInput
from lake_schema.store import garbage, layout, read, request_links
from lake_schema.store.object_storage.s3 import Folder


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with the given arguments, by default those of the process, and return its exit status.

    The status is 0 for success, 1 for a damaged lake, and 2 for wrong arguments.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] == ["mission"]:
        from lake_schema.mission import commands as mission

        return mission.main(arguments[1:])
    parser = argparse.ArgumentParser(prog="python -m lake_schema", description=__doc__, epilog=f"truesky {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="list|verify|gc|describe|tables")
    subparsers = {name: commands.add_parser(name) for name in ("list", "verify", "gc", "describe")}
    for name, subparser in subparsers.items():
        subparser.add_argument("lake", help="folder of the lake" + ("" if name == "gc" else ", or s3://BUCKET/PREFIX"))
        if name != "gc":
            subparser.add_argument(
                "--endpoint-url", help="URL of the object storage (default: $AWS_ENDPOINT_URL, else Amazon S3)"
            )
        subparser.add_argument("table", nargs="?", help="one table (default: all tables)")
        if name in ("verify", "describe"):
            subparser.add_argument("--name", help="only versions of this request (default: all requests)")
    subparsers["list"].add_argument("--json", action="store_true", help="print a JSON list instead of columns")
    subparsers["verify"].add_argument("--deep", action="store_true", help="read every byte and compare its sha256")
    subparsers["gc"].add_argument(
        "--delete", action="store_true", help="remove the listed folders (default: list only)"
    )
    commands.add_parser("tables")
    options = parser.parse_args(arguments)
    if options.command == "tables":
        print(tables.to_markdown(), end="")
        return 0
    return command.run("lake_schema", lambda: _run_command(options))


def _run_command(options: argparse.Namespace) -> int:
    if options.command == "gc":
        return _collect_garbage(layout.resolve_lake(options.lake), options.table, options.delete)
    root = layout.open_lake(options.lake, options.endpoint_url)
    if options.command == "list":
        return _list_versions(root, options.table, options.json)
    request = request_links.check_request(root, options.name) if options.name else None
    table_names = request_links.tables_of_request(root, request) if request else read.table_names(root)
    if not (selected := [options.table] if options.table else table_names):
        raise BadInput(f"lake {root} holds no table")

    def inspect_table(name: str) -> int:
        versions = _versions_of_table(root, name, request)
        return max(int(_verify(v, options.deep) if options.command == "verify" else _describe(v)) for v in versions)

    # Run each table separately: if an error ends the inspection of one table, the others are still inspected.
    return max(command.run("lake_schema", lambda name=name: inspect_table(name)) for name in selected)  # type: ignore[misc]


def _versions_of_table(root: Folder, name: str, request: str | None) -> list[read.Version]:
    """Open the current version of a table and the versions of all requests, each version once.

    If `request` (name of a set of settings) is given, open only its version. Raise BadInput if no version exists.
    """
    if request:
        return [read.version(root, name, request=request)]
    current, keys_by_request = layout.current_key(root, name), request_links.keys_by_request(root, name)
    if current is None and not keys_by_request:
        raise BadInput(f"lake {root} has no table {name}")
    versions_by_key = {keys_by_request[holder]: read.version(root, name, request=holder) for holder in keys_by_request}
    if current is not None and current not in versions_by_key:
        versions_by_key[current] = read.latest_version(root, name)
    return list(versions_by_key.values())


def _list_versions(root: Folder, name: str | None, as_json: bool) -> int:
    rows = [version_row for version_row in listing.rows(root) if name in (None, version_row["table"])]
    if not rows:
        raise BadInput(f"lake {root} has no table {name}")
    print(json.dumps(rows, indent=1) if as_json else listing.format_table(rows))
    return int(any("error" in version_row for version_row in rows))


def _collect_garbage(root: Path, name: str | None, delete: bool) -> int:
    if not garbage.table_names(root):
        raise BadInput(f"lake {root} holds no table")
    paths = garbage.collect(root, name, delete)
    for path in paths:
        print(f"{'removed' if delete else 'would remove'} {path}")
    if paths and not delete:
        print("nothing was removed: gc --delete removes these")
    return 0


def _verify(version: read.Version, deep: bool) -> bool:
    faults = read.find_faults(version, deep)
    for line in faults:
        print(line)
    size = sum(entry["bytes"] for entry in version.manifest["files"])
    verdict = f"{len(faults)} faults" if faults else "sound"
    print(f"{version.table:16} v-{version.key} {version.num_rows:12,} rows {size / 1e6:10.1f} MB   {verdict}")
    return bool(faults)


def _describe(version: read.Version) -> bool:
    schema = version.schema
    print(f"{version.table}: {(schema.metadata or {}).get(b'description', b'').decode()}")
    print(f"  version {version.key}, {version.num_rows:,} rows in {len(version.partitions)} files")
    width = max(len(field.name) for field in schema)
    for field in schema:
        facts = {k.decode(): v.decode() for k, v in (field.metadata or {}).items()}
        print(f"  {field.name:{width}}  {field.type!s:8} {facts.get('unit', ''):20} {facts.get('description', '')}")
    return False


if __name__ == "__main__":
    command.exit_with_status(main)
