"""Reuse partitions of older versions instead of making them again.

If the facts of a task contain `PRODUCT`, the digest of everything that determines its bytes, the partition is taken
from a version with the same task and digest. Its files are linked after their sha256 has been compared.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from lake_schema.errors import Damaged
from lake_schema.store import layout, manifest, request_links
from lake_schema.store.plan import Json, Task
from lake_schema.store.provenance import file_sha256
from lake_schema.store.stage import write_receipt

PRODUCT = "product"


def manifest_facts(task: Task, receipt: Json) -> Json:
    """Return the entries of the manifest for a reusable partition: rows, files, machine."""
    if PRODUCT not in task.facts:
        return {}
    span = {"span": receipt["span"]} if "span" in receipt else {}
    files = [file["path"] for file in receipt["files"]]
    return {"rows": receipt["rows"], "files": files, "machine": receipt["machine"], **span}


def reusable_tasks(root: Path, table: str, request: str) -> Mapping[str, str]:
    """Return the digests (`PRODUCT`) of the reusable partitions of a request's version, by name.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    table : str
        Name of the table.
    request : str
        Name of the request.

    Returns
    -------
    mapping of str to str
        Digests by name; empty if the request has no version or an unreadable one.
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
    """Link the reusable partitions of a version into a stage; missing and damaged ones are left out and made again.

    Parameters
    ----------
    stage : Path
        Folder of the version that is being made.
    version : Path
        Folder of the version that may contain reusable partitions.
    table : str
        Name of the table.
    tasks : sequence of Task
        Tasks that are not done yet.
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
                _link_file(version / entry["path"], stage / entry["path"])
            receipt = {"part": task.name, "rows": previous["rows"], "files": files, "machine": previous["machine"]}
            write_receipt(stage, {**receipt, "span": previous["span"]} if "span" in previous else receipt)


def _intact_entry(folder: Path, entry: Json) -> Json | None:
    """Return the entry of a file that is unchanged since it was published, else None."""
    path = str(entry["path"])
    try:
        if file_sha256(folder / path) != str(entry["sha256"]):
            return None
    except OSError:
        return None
    return {key: value for key, value in entry.items() if key != "rows"}


def _link_file(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = manifest.temporary_path(target)
    try:
        os.link(source, temporary)
    except OSError:
        # The file system does not support hard links.
        shutil.copyfile(source, temporary)
    os.replace(temporary, target)
    # If both names already refer to the same file, os.replace does nothing and the temporary name remains.
    temporary.unlink(missing_ok=True)
    manifest.sync(target.parent)
