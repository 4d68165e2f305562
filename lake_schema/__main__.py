"""Look after a lake: python -m lake_schema list|verify|gc|describe LAKE [TABLE]; `tables` prints the reference page;
`mission list [PATTERN]` prints the mission database, `mission diff A [B]` compares two configurations of it.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from lake_schema import __version__, command, listing, tables
from lake_schema.errors import BadInput
from lake_schema.store import garbage, layout, names, read
from lake_schema.store.object_storage.s3 import Folder


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status: 0 all well, 1 something is wrong with the lake, 2 the call is wrong."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] == ["mission"]:
        from lake_schema.mission import commands as mission

        return mission.main(arguments[1:])
    parser = argparse.ArgumentParser(prog="python -m lake_schema", description=__doc__, epilog=f"truesky {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="list|verify|gc|describe|tables")
    one = {name: commands.add_parser(name) for name in ("list", "verify", "gc", "describe")}
    for name, its in one.items():
        its.add_argument("lake", help="folder of the lake" + ("" if name == "gc" else ", or s3://BUCKET/PREFIX"))
        if name != "gc":
            its.add_argument(
                "--endpoint-url", help="of the object storage (default: $AWS_ENDPOINT_URL, else Amazon S3)"
            )
        its.add_argument("table", nargs="?", help="one table (default: all of them)")
        if name in ("verify", "describe"):
            its.add_argument("--name", help="only what belongs to this request (default: all of them)")
    one["list"].add_argument("--json", action="store_true", help="one JSON list instead of columns")
    one["verify"].add_argument("--deep", action="store_true", help="read every byte and compare its sha256")
    one["gc"].add_argument("--delete", action="store_true", help="remove what is said; without it nothing is")
    commands.add_parser("tables")
    options = parser.parse_args(arguments)
    if options.command == "tables":
        print(tables.markdown(), end="")
        return 0
    return command.status("lake_schema", lambda: _looked_after(options))


def _looked_after(options: argparse.Namespace) -> int:
    if options.command == "gc":
        return _gc(layout.lake(options.lake), options.table, options.delete)
    root = layout.opened(options.lake, options.endpoint_url)
    if options.command == "list":
        return _list(root, options.table, options.json)
    own = names.checked(root, options.name) if options.name else None
    there = names.tables(root, own) if own else read.tables(root)
    if not (chosen := [options.table] if options.table else there):
        raise BadInput(f"lake {root} holds no table")

    def looked_at(name: str) -> int:
        versions = _versions(root, name, own)
        return max(int(_verify(v, options.deep) if options.command == "verify" else _describe(v)) for v in versions)

    # What is wrong with one table is said, and the others are looked at all the same.
    return max(command.status("lake_schema", lambda name=name: looked_at(name)) for name in chosen)  # type: ignore[misc]


def _versions(root: Folder, name: str, own: str | None) -> list[read.Version]:
    """The current version of a table and those of its requests, or the one of a request."""
    if own:
        return [read.version(root, name, request=own)]
    current, held = layout.current_key(root, name), names.holders(root, name)
    if current is None and not held:
        raise BadInput(f"lake {root} has no table {name}")
    found = {held[request]: read.version(root, name, request=request) for request in held}
    if current is not None and current not in found:
        found[current] = read.published_last(root, name)
    return list(found.values())


def _list(root: Folder, name: str | None, as_json: bool) -> int:
    found = [row for row in listing.rows(root) if name in (None, row["table"])]
    if not found:
        raise BadInput(f"lake {root} has no table {name}")
    print(json.dumps(found, indent=1) if as_json else listing.text(found))
    return int(any("error" in row for row in found))


def _gc(root: Path, name: str | None, delete: bool) -> int:
    if not garbage.tables(root):
        raise BadInput(f"lake {root} holds no table")
    found = garbage.collect(root, name, delete)
    for path in found:
        print(f"{'removed' if delete else 'would remove'} {path}")
    if found and not delete:
        print("nothing was removed: gc --delete removes these")
    return 0


def _verify(version: read.Version, deep: bool) -> bool:
    found = read.verify(version, deep)
    for line in found:
        print(line)
    size = sum(entry["bytes"] for entry in version.manifest["files"])
    verdict = f"{len(found)} faults" if found else "sound"
    print(f"{version.table:16} v-{version.key} {version.num_rows:12,} rows {size / 1e6:10.1f} MB   {verdict}")
    return bool(found)


def _describe(version: read.Version) -> bool:
    schema = version.schema
    print(f"{version.table}: {(schema.metadata or {}).get(b'description', b'').decode()}")
    print(f"  version {version.key}, {version.num_rows:,} rows in {len(version.parts)} files")
    width = max(len(field.name) for field in schema)
    for field in schema:
        facts = {k.decode(): v.decode() for k, v in (field.metadata or {}).items()}
        print(f"  {field.name:{width}}  {field.type!s:8} {facts.get('unit', ''):20} {facts.get('description', '')}")
    return False


if __name__ == "__main__":
    command.leave(main)
