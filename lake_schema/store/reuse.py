"""Reuse partitions (files) of published versions of a table in a new version, instead of making them again.

A partition is reusable if its facts (JSON values in the plan, from which it is made) contain the key "product": a
digest of everything that determines its bytes. If an older version has a partition with the same name and facts, its
files are hard-linked into the new version. Before that, their sha256 are compared with the manifest of the older
version.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from lake_schema.errors import Damaged
from lake_schema.store import layout, manifest, request_links
from lake_schema.store.plan import Json, Task
from lake_schema.store.stage import write_receipt

PRODUCT = "product"


def manifest_facts(task: Task, receipt: Json) -> Json:
    """Return the entries that the manifest of a version needs so that later versions can reuse a partition.

    They are its number of rows, files, machine type, and range of primary keys if it is in `receipt`, the record of the
    finished partition. The result is {} if the facts of the task do not contain "product", which reuse requires.
    """
    if PRODUCT not in task.facts:
        return {}
    span = {"span": receipt["span"]} if "span" in receipt else {}
    files = [file["path"] for file in receipt["files"]]
    return {"rows": receipt["rows"], "files": files, "machine": receipt["machine"], **span}


def reusable_tasks(root: Path, table: str, request: str) -> Mapping[str, str]:
    """Return the digests of the partitions in a request's version of a table that a later version may reuse.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    table : str
        Name of the table.
    request : str
        Name of the request (named set of settings).

    Returns
    -------
    mapping of str to str
        Digest of everything that determines the bytes of a partition, by name of the partition. It is empty if the
        request has no version of the table, or if the manifest of the version is damaged.
    """
    key = request_links.linked_key(root, request, table)
    if key is None:
        return {}
    try:
        entries = manifest.load(layout.version_folder(root, table, key), table)["parts"]
    except Damaged:
        return {}
    return {
        entry["name"]: entry["facts"][PRODUCT] for entry in entries if "files" in entry and PRODUCT in entry["facts"]
    }


def link_reusable(stage: Path, version: Path, table: str, tasks: Sequence[Task]) -> None:
    """Link the files of reusable partitions of an old version into the folder of a new version.

    Each linked partition also gets a receipt (JSON record), which marks its task as done. Partitions that the old
    version does not have, or whose files have changed, are left out, so that their tasks make them.

    Parameters
    ----------
    stage : Path
        Folder in which the new version is being made.
    version : Path
        Folder of the old version, which is published.
    table : str
        Name of the table.
    tasks : sequence of Task
        Tasks (one per partition) of the new version that are not done yet.
    """
    if not any(PRODUCT in task.facts for task in tasks):
        return
    try:
        facts = manifest.load(version, table)
    except Damaged:
        return
    entries = {entry["path"]: entry for entry in facts["files"]}
    entries_by_task = {entry["name"]: entry for entry in facts["parts"] if "files" in entry}
    for task in tasks:
        previous = entries_by_task.get(task.name)
        if previous is None or PRODUCT not in task.facts or previous["facts"] != task.facts:
            continue
        files = [entry for path in previous["files"] if (entry := _intact_entry(version, entries[path])) is not None]
        if len(files) == len(previous["files"]):
            for entry in files:
                _link_file(version / entry["path"], layout.check_inside(stage, stage / entry["path"]))
            receipt = {"part": task.name, "rows": previous["rows"], "files": files, "machine": previous["machine"]}
            write_receipt(stage, {**receipt, "span": previous["span"]} if "span" in previous else receipt)


def _intact_entry(folder: Path, entry: Json) -> Json | None:
    """Return the manifest entry of a file without its key "rows", or None if the file is missing or has changed."""
    try:
        manifest.check_contents(folder, entry)
    except Damaged:
        return None
    return {key: value for key, value in entry.items() if key != "rows"}


def _link_file(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = manifest.temporary_path(target)
    try:
        os.link(source, temporary)
    except OSError:
        # Copy the file if the file system does not support hard links.
        shutil.copyfile(source, temporary)
    os.replace(temporary, target)
    # Remove the temporary name, which still exists if `target` was a link to the same file: os.replace does nothing
    # then.
    temporary.unlink(missing_ok=True)
    manifest.sync(target.parent)
