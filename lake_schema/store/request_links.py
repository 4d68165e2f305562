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


def request_names(root: Folder) -> list[str]:
    """Names of the requests that have a table here, sorted."""
    folder = layout.requests_folder(root)
    return sorted(path.name for path in folder.iterdir() if layout.is_name(path.name)) if folder.is_dir() else []


def check_request(root: Folder, name: str) -> str:
    """The name, if the lake has a request of it; else BadInput lists those that it has."""
    if layout.check_name(name) not in (existing := request_names(root)):
        raise BadInput(f"lake {root} has no request {name}" + (f"; it has {', '.join(existing)}" if existing else ""))
    return name


def tables_of_request(root: Folder, name: str) -> list[str]:
    """The tables that a request has a version of, sorted."""
    folder = layout.requests_folder(root) / layout.check_name(name)
    return sorted(path.name for path in folder.iterdir() if layout.is_name(path.name)) if folder.is_dir() else []


def linked_key(root: Folder, name: str, table: str) -> str | None:
    """Key of the version that a request has, which may be missing; None where it has none.

    Errors : Damaged where the link is none, or does not lead to a version of the table
    """
    return layout.linked_key(layout.request_link(root, name, table), table)


def keys_by_request(root: Folder, table: str) -> dict[str, str]:
    """Name of every request that has a version of a table -> its key."""
    keys = {name: linked_key(root, name, table) for name in request_names(root)}
    return {name: key for name, key in keys.items() if key is not None}


def link_version(root: Path, name: str, table: str, key: str) -> None:
    """Give a request a version of a table; the caller holds the table's lock.

    root : of the lake;  name : of the request;  table, key : of the version
    """
    link = layout.request_link(root, name, table)
    if not link.parent.is_dir():
        link.parent.mkdir(parents=True, exist_ok=True)
        sync(link.parent.parent)
        sync(root)
    replace_link(link, f"../../{table}/v-{key}")


def replace_link(link: Path, target: str) -> None:
    """Replace a link in one rename, synced."""
    temporary = link.with_name(f".{link.name}.{os.getpid()}.tmp")
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(target)
    os.replace(temporary, link)
    sync(link.parent)


def version_keys_in(facts: Any) -> Iterator[str]:
    """Every text in a plan's facts that has the form of a version's key, whatever it is called there."""
    pending = [facts]
    while pending:
        value = pending.pop()
        if isinstance(value, Mapping):
            pending += value.values()
        elif isinstance(value, (list, tuple)):
            pending += value
        elif isinstance(value, str) and _KEY.fullmatch(value):
            yield value
