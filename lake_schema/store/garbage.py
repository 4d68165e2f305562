"""What nobody needs any more: versions that no request has and that nothing kept was made of, runs that were given up.

kept        of each table, the versions that stay
collect     says what else there is, and removes it where that is wanted

A version stays that is current, that a request's name links to, or that such a one was made of, however far back. A
folder is renamed before it is emptied: a death in between leaves no half version that looks whole.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from lake_schema.errors import BadInput, Damaged, Superseded
from lake_schema.store import layout, locks, manifest, request_links
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.store.stage import receipts_folder

# What stands in a table's folder by a version's key; and what was on its way out.
_KEY_PATTERN = re.compile(r"(?:v|\.stage|\.receipts|\.lock)-([0-9a-f]{16})", re.ASCII)
_MARKED_PATTERN = ".gone*"


def table_names(root: Folder) -> list[str]:
    """Folders of the lake in which something was published or begun, sorted."""
    return sorted({path.parent.name for path in root.glob("*/.lock*")} | set(layout.table_names(root)))


def kept_versions(root: Path, previous: Mapping[str, set[str]] | None = None) -> dict[str, set[str]]:
    """Table -> keys of the versions that stay.

    root   : of the lake
    known  : what this said before; only the manifests of other versions are read, and what stayed stays
    Errors : Damaged where a version that stays is missing or its manifest broken: what it was made of is not known
    """
    links = [
        (name, layout.current_key(root, name), layout.current_link(root, name)) for name in layout.table_names(root)
    ]
    for request in request_links.request_names(root):
        for name in request_links.tables_of_request(root, request):
            links.append(
                (name, request_links.linked_key(root, request, name), layout.request_link(root, request, name))
            )
    for name, key, link in links:
        if key is not None and not layout.version_folder(root, name, key).exists():
            raise Damaged(f"{link} leads to v-{key}, which is missing: nothing is removed")
    kept_keys: dict[str, set[str]] = defaultdict(set, {name: set(keys) for name, keys in (previous or {}).items()})
    pending = [(name, key) for name, key, _ in links if key is not None]
    existing_tables = table_names(root)
    while pending:
        name, key = pending.pop()
        if key in kept_keys[name]:
            continue
        kept_keys[name].add(key)
        made_of = set(
            request_links.version_keys_in(manifest.load(layout.version_folder(root, name, key), name)["facts"])
        )
        pending += [
            (other, k) for other in existing_tables for k in made_of if layout.version_folder(root, other, k).exists()
        ]
    return kept_keys


def collect(root: Path, name: str | None = None, delete: bool = False) -> list[Path]:
    """What is not kept of a table, or of all of them; removed only where `delete` says so.

    Errors : BadInput where there is no such table; Damaged, and nothing is removed, where it is not known what is kept
    """
    existing_tables = table_names(root)
    selected = existing_tables if name is None else [layout.table_folder(root, name).name]
    if not set(selected) <= set(existing_tables):
        raise BadInput(f"lake {root} has no table {name}")
    kept_keys = kept_versions(root)
    if not delete:
        return [path for table in selected for path in _removable_paths(root, table, kept_keys[table])]
    # What a death has left must not be in the way of a version that was made again since.
    removed = _delete_marked(root, selected)
    with contextlib.ExitStack() as stack:
        # Nobody publishes while it is decided: what has been linked since is looked at, and little else.
        for table in existing_tables:
            stack.enter_context(locks.hold_table(layout.table_folder(root, table)))
        kept_keys = kept_versions(root, kept_keys)
        removed += [path for table in selected for path in _mark_for_removal(root, table, kept_keys[table])]
    _delete_marked(root, selected)
    return removed


def _delete_marked(root: Path, selected: Iterable[str]) -> list[Path]:
    """Remove what is on its way out of some tables."""
    marked = [path for table in selected for path in sorted(layout.table_folder(root, table).glob(_MARKED_PATTERN))]
    for path in marked:
        shutil.rmtree(path, ignore_errors=True)
    return marked


def _removable_paths(root: Path, name: str, kept_keys: set[str]) -> list[Path]:
    folder, removable = layout.table_folder(root, name), []
    for key in _version_keys(folder):
        if not locks.is_held(folder / f".lock-{key}"):
            removable += _removable_folders(root, name, key, kept_keys)
    return [*removable, *sorted(folder.glob(_MARKED_PATTERN))]


def _mark_for_removal(root: Path, name: str, kept_keys: set[str]) -> Iterator[Path]:
    """Give what can go another name; stages that a run is working on stay."""
    folder = layout.table_folder(root, name)
    for key in _version_keys(folder):
        lock = folder / f".lock-{key}"
        with contextlib.suppress(Superseded), locks.hold(lock, "in use"):
            for path in _removable_folders(root, name, key, kept_keys):
                os.rename(path, folder / f".gone{path.name}")
                yield path
            lock.unlink()


def _version_keys(folder: Path) -> list[str]:
    return sorted({match[1] for path in folder.iterdir() if (match := _KEY_PATTERN.fullmatch(path.name))})


def _removable_folders(root: Path, name: str, key: str, kept_keys: set[str]) -> list[Path]:
    stage = layout.stage_folder(root, name, key)
    folders = [stage, receipts_folder(stage)] + ([] if key in kept_keys else [layout.version_folder(root, name, key)])
    return [path for path in folders if path.exists()]
