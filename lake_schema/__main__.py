"""Look after a lake: python -m lake_schema verify|gc|describe LAKE [TABLE]; `tables` prints the reference page;
`mission list [PATTERN]` prints the mission database, `mission diff A [B]` compares two configurations of it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from lake_schema import __version__, command, tables
from lake_schema.errors import BadInput
from lake_schema.store import layout, publish, read


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status: 0 all well, 1 something is wrong with the lake, 2 the call is wrong."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] == ["mission"]:
        from lake_schema.mission import commands as mission

        return mission.main(arguments[1:])
    parser = argparse.ArgumentParser(prog="python -m lake_schema", description=__doc__, epilog=f"truesky {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="verify|gc|describe|tables")
    for name in ("verify", "gc", "describe"):
        one = commands.add_parser(name)
        one.add_argument("lake", help="folder of the lake")
        one.add_argument("table", nargs="?", help="one table (default: all of them)")
        one.set_defaults(deep=False)
        if name == "verify":
            one.add_argument("--deep", action="store_true", help="read every byte and compare its sha256")
    commands.add_parser("tables")
    options = parser.parse_args(arguments)
    if options.command == "tables":
        print(tables.markdown(), end="")
        return 0
    return command.status("lake_schema", lambda: _looked_after(options))


def _looked_after(options: argparse.Namespace) -> int:
    root = layout.lake(options.lake)
    names = [options.table] if options.table else _names(root, options.command)
    if not names:
        raise BadInput(f"lake {root} holds no table")
    actions = {"verify": _verify, "gc": _gc, "describe": _describe}
    # What is wrong with one table is said, and the others are looked at all the same.
    return max(_status(actions[options.command], root, name, options.deep) for name in names)


def _names(root: Path, command: str) -> list[str]:
    """The published tables; gc also looks where nothing has been published yet."""
    if command != "gc":
        return read.tables(root)
    return sorted({path.parent.name for path in root.glob("*/.lock*")})


def _status(action: Callable[[Path, str, bool], bool], root: Path, name: str, deep: bool) -> int:
    return command.status("lake_schema", lambda: int(action(root, name, deep)))


def _verify(root: Path, name: str, deep: bool) -> bool:
    version = read.version(root, name)
    found = read.verify(version, deep)
    for line in found:
        print(line)
    size = sum(entry["bytes"] for entry in version.manifest["files"])
    verdict = f"{len(found)} faults" if found else "sound"
    print(f"{name:16} v-{version.key} {version.num_rows:12,} rows {size / 1e6:10.1f} MB   {verdict}")
    return bool(found)


def _gc(root: Path, name: str, deep: bool) -> bool:
    for path in publish.gc(root, name):
        print(f"removed {path}")
    return False


def _describe(root: Path, name: str, deep: bool) -> bool:
    version = read.version(root, name)
    schema = version.schema
    print(f"{name}: {(schema.metadata or {}).get(b'description', b'').decode()}")
    print(f"  version {version.key}, {version.num_rows:,} rows in {len(version.parts)} files")
    width = max(len(field.name) for field in schema)
    for field in schema:
        facts = {k.decode(): v.decode() for k, v in (field.metadata or {}).items()}
        print(f"  {field.name:{width}}  {field.type!s:8} {facts.get('unit', ''):20} {facts.get('description', '')}")
    return False


if __name__ == "__main__":
    sys.exit(main())
