"""List, verify, describe and clean up the tables of a lake: the commands list, verify, describe, gc and tables."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lake_schema import command, listing, tables
from lake_schema.store import garbage, layout, read, request_links
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.texts import text_tables

_Row = dict[str, Any]


def run_command(options: argparse.Namespace) -> int:
    """Run the command `options.command` with its parsed arguments, and return its exit status.

    The status is 0 for success and 1 for a damaged lake. BadInput is raised for wrong arguments.
    """
    if options.command == "tables":
        print(tables.to_markdown(), end="")
        return 0
    if options.command == "gc":
        return _collect_garbage(layout.resolve_lake(options.lake), options.table, options.delete)
    root = layout.open_lake(options.lake, options.endpoint_url)
    if options.command == "list":
        return _list_versions(root, options.table, options.json)
    request = request_links.check_request(root, options.name) if options.name else None
    table_names = request_links.tables_of_request(root, request) if request else read.table_names(root)
    if not (selected := [options.table] if options.table else table_names):
        raise layout.missing_table(root)
    rows_of_version: Callable[[read.Version], list[_Row]] = (
        _describe if options.command == "describe" else lambda version: [_verify(version, options.deep)]
    )
    print_version = _print_description if options.command == "describe" else _print_verification
    json_rows: list[_Row] = []

    def inspect_table(name: str) -> int:
        has_faults = False
        for version in _versions_of_table(root, name, request):
            rows = rows_of_version(version)
            has_faults = has_faults or any(row.get("faults") for row in rows)
            if options.json:
                json_rows.extend(rows)
            else:
                print_version(version, rows)
        return int(has_faults)

    # Inspect each table separately: if an error ends the inspection of one table, the others are still inspected.
    status = max(
        command.run(f"truesky {options.command}", lambda name=name: inspect_table(name))  # type: ignore[misc]
        for name in selected
    )
    if options.json:
        text_tables.print_json(json_rows)
    return status


def _versions_of_table(root: Folder, name: str, request: str | None) -> list[read.Version]:
    """Open the current version of a table and the versions of all requests, each version once.

    If `request` (name of a set of settings) is given, open only its version. Raise BadInput if no version exists.
    """
    if request:
        return [read.version(root, name, request=request)]
    current, keys_by_request = layout.current_key(root, name), request_links.keys_by_request(root, name)
    if current is None and not keys_by_request:
        raise layout.missing_table(root, name, read.table_names(root))
    versions_by_key = {keys_by_request[holder]: read.version(root, name, request=holder) for holder in keys_by_request}
    if current is not None and current not in versions_by_key:
        versions_by_key[current] = read.latest_version(root, name)
    return list(versions_by_key.values())


def _list_versions(root: Folder, name: str | None, as_json: bool) -> int:
    all_rows = listing.rows(root)
    rows = [version_row for version_row in all_rows if name in (None, version_row["table"])]
    if not rows:
        raise layout.missing_table(root, name or "", list(dict.fromkeys(row["table"] for row in all_rows)))
    if as_json:
        text_tables.print_json(rows)
    else:
        print(listing.format_table(rows))
    return int(any("error" in version_row for version_row in rows))


def _collect_garbage(root: Path, name: str | None, delete: bool) -> int:
    if not garbage.table_names(root):
        raise layout.missing_table(root)
    paths = garbage.collect(root, name, delete)
    for path in paths:
        print(f"{'removed' if delete else 'would remove'} {path}")
    if paths and not delete:
        print("nothing was removed: gc --delete removes these")
    return 0


def _verify(version: read.Version, deep: bool) -> _Row:
    return {
        "table": version.table,
        "version": version.key,
        "rows": version.num_rows,
        "bytes": sum(entry["bytes"] for entry in version.manifest["files"]),
        "faults": read.find_faults(version, deep),
    }


def _print_verification(version: read.Version, rows: list[_Row]) -> None:
    (row,) = rows
    for line in row["faults"]:
        print(line)
    verdict = f"{len(row['faults'])} faults" if row["faults"] else "sound"
    print(f"{version.table:16} v-{version.key} {row['rows']:12,} rows {row['bytes'] / 1e6:10.1f} MB   {verdict}")


def _describe(version: read.Version) -> list[_Row]:
    rows = []
    for field in version.schema:
        facts = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
        meaning = {"unit": facts.get("unit", ""), "meaning": facts.get("description", "")}
        rows.append({"table": version.table, "column": field.name, "type": str(field.type), **meaning})
    return rows


def _print_description(version: read.Version, rows: list[_Row]) -> None:
    print(f"{version.table}: {(version.schema.metadata or {}).get(b'description', b'').decode()}")
    print(f"  version {version.key}, {version.num_rows:,} rows in {len(version.partitions)} files")
    headings = ("column", "type", "unit", "meaning")
    for line in text_tables.format_table(headings, [[row[name] for name in headings] for row in rows]):
        print(f"  {line}")
