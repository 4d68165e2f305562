"""Find and remove versions and stages that are no longer needed.

A version is kept if it is current, if a request links to it, or if a kept version was made from it, directly or
indirectly. All other versions, and the stages of runs that have ended, can be removed. A folder is renamed before it is
emptied, so that an interrupted removal leaves no incomplete version that looks complete.
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

# Names with a version's key in a table's folder, and names of folders that are marked for removal.
_KEY_PATTERN = re.compile(r"(?:v|\.stage|\.receipts|\.lock)-([0-9a-f]{16})", re.ASCII)
_MARKED_PATTERN = ".gone*"


def table_names(root: Folder) -> list[str]:
    """Return the sorted names of the tables that have been published or begun in a lake."""
    return sorted({path.parent.name for path in root.glob("*/.lock*")} | set(layout.table_names(root)))


def kept_versions(root: Path, previous: Mapping[str, set[str]] | None = None) -> dict[str, set[str]]:
    """Return the keys of the versions that are kept, by table.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    previous : mapping of str to set of str, optional
        Earlier result of this function. These versions are kept, and their manifests are not read again.

    Returns
    -------
    dict of str to set of str
        Keys by table.

    Raises
    ------
    Damaged
        If a kept version is missing or its manifest is broken, because its inputs are then unknown.
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
    """Return the paths that are not needed, and remove them if requested.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    name : str, optional
        Name of a table; by default all tables.
    delete : bool, optional
        True to remove the paths.

    Returns
    -------
    list of Path
        Folders that can be removed, or that were removed.

    Raises
    ------
    BadInput
        If there is no such table.
    Damaged
        If it is unknown which versions are needed. Nothing is removed then.
    """
    existing_tables = table_names(root)
    selected = existing_tables if name is None else [layout.table_folder(root, name).name]
    if not set(selected) <= set(existing_tables):
        raise BadInput(f"lake {root} has no table {name}")
    kept_keys = kept_versions(root)
    if not delete:
        return [path for table in selected for path in _removable_paths(root, table, kept_keys[table])]
    # Remains of an interrupted removal must not block a version that has been made again since.
    removed = _delete_marked(root, selected)
    with contextlib.ExitStack() as stack:
        # Nothing can be published while the locks are held. Only links that are new since the first pass are followed.
        for table in existing_tables:
            stack.enter_context(locks.hold_table(layout.table_folder(root, table)))
        kept_keys = kept_versions(root, kept_keys)
        removed += [path for table in selected for path in _mark_for_removal(root, table, kept_keys[table])]
    _delete_marked(root, selected)
    return removed


def _delete_marked(root: Path, selected: Iterable[str]) -> list[Path]:
    """Delete the folders of some tables that are marked for removal, and return their paths."""
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
    """Rename folders that can be removed; stages on which a run is working stay."""
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
