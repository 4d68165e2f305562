"""List the results that truesky keeps on disc between runs, and remove entries.

Usage: truesky cache [--prune] [options]

A removed entry is computed again when it is needed. Entries that a running process uses are kept.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Iterator, Sequence

from lake_schema.errors import BadInput
from truesky.command_line import commands
from truesky.command_line.parser import suggestion
from truesky.numerics import cache, cache_entries
from truesky.numerics.cache_entries import KINDS, Entry, Removal

_DAY_S = 86_400.0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with the given arguments (by default sys.argv), and return its exit status."""
    return commands.run("cache", run_command, argv)


def run_command(options: argparse.Namespace) -> int:
    """List or remove entries of the cache, as the parsed arguments of `truesky cache` ask, and return 0.

    BadInput is raised for an unknown kind of entry, and for options that do not belong together.
    """
    kinds = [name for name, _, _ in KINDS]
    for kind in options.kind:
        if kind not in kinds:
            raise BadInput(f"--kind {kind} is not one of {', '.join(kinds)}{suggestion(kind, kinds)}")
    for name in ("limit", "older_than"):
        value = getattr(options, name)
        if value is not None and not value >= 0.0:
            raise BadInput(f"--{name.replace('_', '-')} {value:g} must be at least 0")
    if not options.prune and (options.all or options.limit is not None or options.older_than is not None):
        raise BadInput("--all, --limit and --older-than require --prune")
    root, limit = cache.cache_dir(), cache_entries.limit_bytes()
    chosen = _choose(cache_entries.entries(root), options.kind)
    removal = Removal((), ())
    if options.prune:
        removal = cache_entries.prune(root, chosen, *_amount(options, limit))
        chosen = _choose(cache_entries.entries(root), options.kind)
    if options.json:
        print(json.dumps(_summary(chosen, removal, options.entries), indent=1))
        return 0
    if options.prune:
        print(f"removed {_count(removal.removed)}")
        if removal.in_use:
            print(f"kept {_count(removal.in_use)}, which a running process uses")
    else:
        print(*_table(chosen, options.entries), sep="\n")
    print(f"{root}: {_count(chosen)}; {_describe_limit(limit)}")
    return 0


def _choose(entries: Sequence[Entry], kinds: Sequence[str]) -> list[Entry]:
    return [entry for entry in entries if not kinds or entry.kind in kinds]


def _amount(options: argparse.Namespace, limit: float) -> tuple[float, float]:
    """Return the number of bytes that may remain, and the time (s) since their last use of entries to be removed."""
    if options.older_than is not None:
        return 0.0, _DAY_S * options.older_than
    if options.all:
        return 0.0, 0.0
    return limit if options.limit is None else 1e9 * options.limit, 0.0


def _table(entries: Sequence[Entry], with_entries: bool) -> Iterator[str]:
    """Yield the lines of a table with one line per kind, or per entry; the largest kinds and entries first."""
    yield f"{'kind':11}{'contents':40}{'entries':>8}{'GB':>9}  last use"
    rows = []
    for kind, contents, _ in (*KINDS, ("leftover", "of processes that were killed", "")):
        members = [entry for entry in entries if entry.kind == kind]
        if with_entries:
            rows += [(entry.size, kind, entry.folder.name[:39], 1, entry.last_use) for entry in members]
        elif members:
            size, last_use = sum(entry.size for entry in members), max(entry.last_use for entry in members)
            rows.append((size, kind, contents, len(members), last_use))
    for size, kind, contents, count, last_use in sorted(rows, reverse=True):
        yield f"{kind:11}{contents:40}{count:8,}{size / 1e9:9.3f}  {_format_age(time.time() - last_use)}"


def _format_age(seconds: float) -> str:
    for unit, length in (("day", _DAY_S), ("hour", 3600.0), ("minute", 60.0)):
        if seconds >= length:
            count = int(seconds / length)
            return f"{count} {unit}{'s' if count > 1 else ''} ago"
    return "now"


def _count(entries: Sequence[Entry]) -> str:
    gigabytes = sum(entry.size for entry in entries) / 1e9
    return f"{len(entries):,} {'entry' if len(entries) == 1 else 'entries'}, {gigabytes:.3f} GB"


def _describe_limit(limit: float) -> str:
    return "no limit" if math.isinf(limit) else f"limit {limit / 1e9:g} GB"


def _summary(entries: Sequence[Entry], removal: Removal, with_entries: bool) -> dict[str, object]:
    """Return the contents of the cache and the removed entries as JSON values (bytes, seconds since 1970)."""
    limit = cache_entries.limit_bytes()
    kinds: dict[str, dict[str, float]] = {}
    for entry in entries:
        row = kinds.setdefault(entry.kind, {"entries": 0, "bytes": 0, "last_use": 0.0})
        row |= {"entries": row["entries"] + 1, "bytes": row["bytes"] + entry.size}
        row["last_use"] = max(row["last_use"], entry.last_use)
    listed = [{"name": e.folder.name, "kind": e.kind, "bytes": e.size, "last_use": e.last_use} for e in entries]
    return {
        "folder": str(cache.cache_dir()),
        "limit_bytes": None if math.isinf(limit) else limit,
        "bytes": sum(entry.size for entry in entries),
        "kinds": kinds,
        **({"entries": listed} if with_entries else {}),
        "removed_bytes": sum(entry.size for entry in removal.removed),
        "removed_entries": len(removal.removed),
        "in_use_entries": len(removal.in_use),
    }
