"""Symbolic links from requests to their versions of tables, so that several requests can share a lake; their areas.

A request is a named set of settings of a simulation. Its links are LAKE/names/<name>/<table> ->
../../<table>/v-<key>. A link is replaced in one rename. The garbage collection keeps linked versions and the versions
from which they were made.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from lake_schema.errors import BadInput, Damaged
from lake_schema.store import layout
from lake_schema.store.manifest import sync, write_json
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.store.provenance import digest
from lake_schema.texts import spelling

_KEY = re.compile(r"[0-9a-f]{16}", re.ASCII)
# File in the folder of a request with the area of the sky that it covers. No table has this name.
_AREA = "area.json"
# Key in this file with the sha256 of the area.
_DIGEST = "digest"


def request_names(root: Folder) -> list[str]:
    """Return the sorted names of the requests (named sets of settings) that have a table in the lake."""
    folder = layout.requests_folder(root)
    return sorted(path.name for path in folder.iterdir() if layout.is_name(path.name)) if folder.is_dir() else []


def check_request(root: Folder, name: str) -> str:
    """Return `name` if the lake has a request (named set of settings) of this name, else raise BadInput.

    The message lists the names that the lake has.
    """
    existing = request_names(root)
    if not isinstance(name, str) or name not in existing:
        text = str(name)[:100]
        reason = "" if layout.is_name(text) else ", because names have only small letters, digits, _ and -"
        question = spelling.did_you_mean(text, existing)
        listed = f"; {f'{question} ' if question else ''}it has {', '.join(existing)}" if existing else ""
        raise BadInput(f"lake {root} has no request {text}{reason}{listed}")
    return name


def tables_of_request(root: Folder, name: str) -> list[str]:
    """Return the sorted names of the tables of which a request (named set of settings) has a version.

    The result is [] if there is no such request.
    """
    folder = layout.request_folder(root, name)
    return sorted(path.name for path in folder.iterdir() if layout.is_name(path.name)) if folder.is_dir() else []


def linked_key(root: Folder, name: str, table: str) -> str | None:
    """Return the key of the version of a table that belongs to a request, or None if the request has no such table.

    A request is a named set of settings; a symbolic link in the lake leads from it to each of its versions.

    Parameters
    ----------
    root : Path or ObjectPath
        Root of the lake.
    name : str
        Name of the request.
    table : str
        Name of the table.

    Returns
    -------
    str or None
        Key of the version, 16 hexadecimal digits. Whether the version exists is not checked.

    Raises
    ------
    Damaged
        If the link leads elsewhere than to a version of the table, or is not a link.
    """
    return layout.linked_key(layout.request_link(root, name, table), table)


def keys_by_request(root: Folder, table: str) -> dict[str, str]:
    """Return the key of the version of a table that belongs to each request (named set of settings), by its name.

    Requests that have no version of the table are left out.
    """
    keys = {name: linked_key(root, name, table) for name in request_names(root)}
    return {name: key for name, key in keys.items() if key is not None}


def link_version(root: Path, name: str, table: str, key: str) -> None:
    """Create or replace the symbolic link from a request (named set of settings) to its version of a table.

    The caller must hold the lock of the table.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    name : str
        Name of the request.
    table : str
        Name of the table.
    key : str
        Key of the version. Whether the version exists is not checked.
    """
    link = layout.request_link(root, name, table)
    if not link.parent.is_dir():
        link.parent.mkdir(parents=True, exist_ok=True)
        sync(link.parent.parent)
        sync(root)
    replace_link(link, f"../../{table}/v-{key}")


def replace_link(link: Path, target: str) -> None:
    """Create or replace a symbolic link to `target` in one rename, and sync it to disc."""
    temporary = link.with_name(f".{link.name}.{os.getpid()}.tmp")
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(target)
    os.replace(temporary, link)
    sync(link.parent)


def version_keys_in(facts: Any) -> Iterator[str]:
    """Yield every string of 16 hexadecimal digits, the form of a version's key, in nested JSON values.

    `facts` are the values from which a version of a table is made. They include the keys of the versions of other
    tables that are read, which are found by their form.
    """
    pending = [facts]
    while pending:
        value = pending.pop()
        if isinstance(value, Mapping):
            pending += value.values()
        elif isinstance(value, (list, tuple)):
            pending += value
        elif isinstance(value, str) and _KEY.fullmatch(value):
            yield value


def write_area(root: Path, name: str, area: Mapping[str, Any]) -> None:
    """Record the area of a request in the folder of its links, which must exist.

    Catalogues cover whole cells of the sky, so they do not contain the area. Two requests with different areas can have
    the same version of a table.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    name : str
        Name of the request.
    area : mapping
        The area as JSON values.

    Raises
    ------
    BadInput
        If the area is not recorded yet and the lake cannot be written.
    Damaged
        If the area was recorded in a file that is not valid.
    """
    if read_area(root, name) != area:
        with layout.report_unwritable(root):
            write_json(layout.request_folder(root, name) / _AREA, {**area, _DIGEST: digest(area)})


def read_area(root: Folder, name: str) -> dict[str, Any] | None:
    """Return the recorded area of a request, or None if the lake does not record it or is on object storage.

    Areas without a digest, as older versions of truesky wrote them, count as not recorded. Damaged is raised if the
    file is not valid, or has changed since it was written.
    """
    path = layout.request_folder(root, name) / _AREA
    if not isinstance(path, Path) or not path.is_file():
        return None
    try:
        area = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(area, dict):
            raise Damaged(f"{path}: must contain an object")
        seal = area.pop(_DIGEST, None)
        has_changed = seal is not None and digest(area) != seal
    except (ValueError, RecursionError) as error:
        raise Damaged(f"{path}: {error}") from None
    if seal is None:
        return None
    if has_changed:
        raise Damaged(f"{path} has changed since it was written: its digest differs")
    return area
