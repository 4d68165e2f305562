"""Requests side by side in one lake: which version of each table belongs to which of them.

LAKE/names/<name>/<table> -> ../../<table>/v-<key>

A link is replaced in one rename.  What a name links to, and what that was made of, is never removed.

names       of the requests in a lake
key_of      of a table, the version that a request has
holders     of a table, every request that has a version
keys_in     keys of versions that the facts of a plan name: what it was made of
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from lake_schema.errors import BadInput
from lake_schema.store import layout
from lake_schema.store.manifest import sync
from lake_schema.store.object_storage.s3 import Folder

_KEY = re.compile(r"[0-9a-f]{16}", re.ASCII)


def names(root: Folder) -> list[str]:
    """Names of the requests that have a table here, sorted."""
    folder = layout.named(root)
    return sorted(path.name for path in folder.iterdir() if layout.is_name(path.name)) if folder.is_dir() else []


def checked(root: Folder, name: str) -> str:
    """The name, if the lake has a request of it; else BadInput lists those that it has."""
    if layout.name(name) not in (known := names(root)):
        raise BadInput(f"lake {root} has no request {name}" + (f"; it has {', '.join(known)}" if known else ""))
    return name


def tables(root: Folder, name: str) -> list[str]:
    """The tables that a request has a version of, sorted."""
    folder = layout.named(root) / layout.name(name)
    return sorted(path.name for path in folder.iterdir() if layout.is_name(path.name)) if folder.is_dir() else []


def key_of(root: Folder, name: str, table: str) -> str | None:
    """Key of the version that a request has, which may be missing; None where it has none.

    Errors : Damaged where the link is none, or does not lead to a version of the table
    """
    return layout.linked_key(layout.pin(root, name, table), table)


def holders(root: Folder, table: str) -> dict[str, str]:
    """Name of every request that has a version of a table -> its key."""
    found = {name: key_of(root, name, table) for name in names(root)}
    return {name: key for name, key in found.items() if key is not None}


def pin(root: Path, name: str, table: str, key: str) -> None:
    """Give a request a version of a table; the caller holds the table's lock.

    root : of the lake;  name : of the request;  table, key : of the version
    """
    link = layout.pin(root, name, table)
    if not link.parent.is_dir():
        link.parent.mkdir(parents=True, exist_ok=True)
        sync(link.parent.parent)
        sync(root)
    swap(link, f"../../{table}/v-{key}")


def swap(link: Path, target: str) -> None:
    """Replace a link in one rename, synced."""
    temporary = link.with_name(f".{link.name}.{os.getpid()}.tmp")
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(target)
    os.replace(temporary, link)
    sync(link.parent)


def keys_in(facts: Any) -> Iterator[str]:
    """Every text in a plan's facts that has the form of a version's key, whatever it is called there."""
    waiting = [facts]
    while waiting:
        value = waiting.pop()
        if isinstance(value, Mapping):
            waiting += value.values()
        elif isinstance(value, (list, tuple)):
            waiting += value
        elif isinstance(value, str) and _KEY.fullmatch(value):
            yield value
