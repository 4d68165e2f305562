"""Find and remove versions of tables that are no longer needed, and folders of versions that were never finished.

A version is kept if it is the current version of its table, if a request (named set of settings) links to it, or if
another kept version was made from it, directly or indirectly. Unfinished versions of runs that have ended are removed,
too. A folder is renamed before it is emptied, so that an interrupted removal leaves no version that looks complete.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from lake_schema.errors import Damaged, Superseded
from lake_schema.store import layout, locks, manifest, request_links
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.store.stage import receipts_folder

# Names in the folder of a table that end in the key of a version: the version, an unfinished version (stage), its
# receipts (records of finished files), and its lock file.
_KEY_PATTERN = re.compile(r"(?:v|\.stage|\.receipts|\.lock)-([0-9a-f]{16})", re.ASCII)
# Names of folders that have been renamed because they will be removed.
_MARKED_PATTERN = ".gone*"


def table_names(root: Folder) -> list[str]:
    """Return the sorted names of the tables of a lake, including tables of which no version has been finished."""
    return sorted({path.parent.name for path in root.glob("*/.lock*")} | set(layout.table_names(root)))


def existing_versions(root: Folder, name: str) -> set[str]:
    """Return the keys of all versions of a table, whether or not a link leads to them."""
    return {path.name.removeprefix("v-") for path in layout.table_folder(root, name).glob("v-*")}


def kept_versions(root: Path, previous: Mapping[str, set[str]] | None = None) -> dict[str, set[str]]:
    """Return the keys of the versions that must be kept, because a link leads to them or a kept version used them.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    previous : mapping of str to set of str, optional
        Earlier result of this function. Its versions are kept, too, and their manifests are not read again.

    Returns
    -------
    dict of str to set of str
        Keys (16 hexadecimal digits that name a version's folder) by name of the table.

    Raises
    ------
    Damaged
        If a link leads to a version that is missing, or the manifest of a kept version is broken. The versions from
        which it was made are then unknown.
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
    existing_keys = {name: existing_versions(root, name) for name in table_names(root)}
    while pending:
        name, key = pending.pop()
        if key in kept_keys[name]:
            continue
        kept_keys[name].add(key)
        made_of = set(
            request_links.version_keys_in(manifest.load(layout.version_folder(root, name, key), name)["facts"])
        )
        pending += [(other, k) for other, existing in existing_keys.items() for k in made_of & existing]
    return kept_keys


def collect(root: Path, name: str | None = None, delete: bool = False) -> list[Path]:
    """Return the folders of versions that are not needed, and remove them if requested.

    A version is needed if a link leads to it, or if a needed version was made from it. The folders of unfinished
    versions are not needed after their runs have ended.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    name : str, optional
        Name of a table; by default all tables.
    delete : bool, optional
        True to remove the folders. By default they are only listed.

    Returns
    -------
    list of Path
        Folders that can be removed, or that were removed. Folders on which a run is working are left out.

    Raises
    ------
    BadInput
        If there is no such table, or the lake cannot be written.
    Damaged
        If a link or a manifest is broken, so that it is unknown which versions are needed. Nothing is removed then.
    """
    existing_tables = table_names(root)
    selected = existing_tables if name is None else [layout.table_folder(root, name).name]
    if not set(selected) <= set(existing_tables):
        raise layout.missing_table(root, selected[0], existing_tables)
    kept_keys = kept_versions(root)
    if not delete:
        return [path for table in selected for path in _removable_paths(root, table, kept_keys[table])]
    # First delete folders that an interrupted removal has renamed. Otherwise a new folder could not be renamed to the
    # same name below.
    removed = _delete_marked(root, selected)
    with contextlib.ExitStack() as stack:
        stack.enter_context(layout.report_unwritable(root))
        # Lock all tables, so that nothing is published during the removal. Then follow the links again, because a
        # version may have been published since the first pass.
        for table in existing_tables:
            stack.enter_context(locks.hold_table(layout.table_folder(root, table)))
        kept_keys = kept_versions(root, kept_keys)
        removed += [path for table in selected for path in _mark_for_removal(root, table, kept_keys[table])]
    _delete_marked(root, selected)
    return removed


def _delete_marked(root: Path, selected: Iterable[str]) -> list[Path]:
    """Delete the folders of the selected tables whose names mark them for removal (.gone*), and return their paths."""
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
    """Rename the folders of a table that can be removed to .gone*, and yield their old paths.

    They are the folders of unfinished versions, and of versions whose keys are not in `kept_keys`. Folders of a version
    whose lock another process holds are left, because a run is working on them.
    """
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
