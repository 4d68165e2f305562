"""Make and publish versions of tables, so that readers never see an incomplete version.

A plan describes a table, everything that determines its contents, and its tasks, one per partition (file). A hash of
the plan is the key of the version.

1. Each partition is written to LAKE/<table>/.stage-<key> under a temporary name, synced to disc, hashed and renamed.
   Its receipt, a JSON record of its files, is written last, in the same way.
2. When all partitions exist, HATS metadata and the manifest (list of all files) are written, and one rename of the
   folder publishes the version. Then two symbolic links to the version are replaced, each by one rename: the link of
   the request (named set of settings) for which it was made, and the link `current` of the table.

If a run is killed::

    at this point                                readers see                       the next run makes
    before the first receipt                     the last version                  everything
    between receipts                             the last version                  partitions without a valid receipt
    after the last receipt, before the rename    the last version                  the metadata and the rename
    after the rename, before the request's link  the last version                  both links
    between the two links                        new one if they name the request  the link `current`
    after both links                             the new version                   nothing
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path

from lake_schema import __version__
from lake_schema.errors import Damaged, Superseded, TasksFailed
from lake_schema.store import hats_files, layout, locks, manifest, request_links, reuse
from lake_schema.store.layout import current_key
from lake_schema.store.manifest import sync
from lake_schema.store.plan import Json, Output, Plan, Task, TaskFunction, data_path
from lake_schema.store.stage import (
    completed_receipts,
    discard_damaged,
    is_done,
    missing_tasks,
    receipts_folder,
    refuse_links,
    run_task,
    write_partition,
)
from lake_schema.store.uniqueness import refuse_duplicates

__all__ = [
    "Json",
    "Mapper",
    "Output",
    "Plan",
    "Task",
    "TaskFunction",
    "current_key",
    "data_path",
    "is_done",
    "make_version",
    "missing_tasks",
    "receipts_folder",
    "run_task",
    "write_partition",
]  # fmt: skip

Mapper = Callable[[Callable[[Task], Json], Sequence[Task]], Iterable[Json]]


def make_version(
    root: Path,
    plan: Plan,
    task_function: TaskFunction,
    mapper: Mapper = map,
    base: str | None = "",
    name: str | None = None,
) -> Path:
    """Make the missing partitions of a version of a table, and publish it as the current version.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    plan : Plan
        Declaration of the table, facts that determine its contents, and tasks (one per partition).
    task_function : callable
        Function of (folder of the lake, facts of the plan and of the task in one dict) that returns the Output of a
        task. `mapper` decides in which process it runs.
    mapper : callable, optional
        Function like map: takes (function, tasks) and returns results in any order. The results are only used to report
        failures. A task is done if its receipt (JSON record of its files) exists in the lake.
    base : str or None, optional
        Key of the version that the new version may replace; None if there must not be any. By default ("") it is the
        version that exists at the call: the version of the request if `name` is given, else the current one.
    name : str, optional
        Name of the request (named set of settings) for which the version is made. The request is then linked to the
        version, and to the versions of other tables that are its inputs, unless the request has a link for that table.

    Returns
    -------
    Path
        Folder of the version. If the version exists and is current, nothing is made or written.

    Raises
    ------
    BadInput
        If the lake cannot be written.
    TasksFailed
        If tasks failed. The output of the other tasks is kept for the next run.
    Superseded
        If another run is making the same version, or has replaced the version `base` by a third one.
    Damaged
        If the version exists and its files differ from its manifest, or a finished file has disappeared.
    """
    table, key = plan.table.name, plan.key
    replaced_key = _replaced_key(root, table, name)
    base = replaced_key if base == "" else base
    target = layout.version_folder(root, table, key)
    folder = layout.table_folder(root, table)
    lock = folder / f".lock-{key}"
    if replaced_key == current_key(root, table) == key and target.exists() and not lock.exists():
        # The version is complete and both links lead to it. Return before locking, because a lock file cannot be
        # created in a lake that is not writable.
        _refuse_damaged(target, table)
        return target
    with layout.report_unwritable(root):
        folder.mkdir(parents=True, exist_ok=True)
        if name is not None:
            _pin_inputs(root, plan, name)
        with locks.hold(lock, f"table {table}: another run is making version {key}", locks.SHORT_TIMEOUT):
            if target.exists():
                _refuse_damaged(target, table)
            else:
                stage = layout.stage_folder(root, table, key)
                refuse_links(stage)
                stage.mkdir(exist_ok=True)
                _finish_stage(stage, plan, _run_tasks(root, plan, task_function, mapper, name))
            _publish(root, plan, base, name)
    return target


def _replaced_key(root: Path, table: str, name: str | None) -> str | None:
    """Return the key of the version of a table that a new version would replace, or None without such a version.

    It is the version of the request (named set of settings) `name`. If `name` is None, it is the current version.
    """
    return current_key(root, table) if name is None else request_links.linked_key(root, name, table)


def _pin_inputs(root: Path, plan: Plan, name: str) -> None:
    """Link a request (named set of settings) to the versions of other tables from which the new version is made.

    A table to which the request has a link is left out. The links keep the garbage collection from removing the
    versions while tasks read them.
    """
    keys = set(request_links.version_keys_in(plan.facts))
    for table in set(layout.table_names(root)) - {plan.table.name}:
        for key in sorted(keys):
            target = layout.version_folder(root, table, key)
            if target.exists() and request_links.linked_key(root, name, table) is None:
                with locks.hold_table(layout.table_folder(root, table)):
                    if target.exists() and request_links.linked_key(root, name, table) is None:
                        request_links.link_version(root, name, table, key)


def _refuse_damaged(target: Path, name: str) -> None:
    if faults := manifest.faults(target, manifest.load(target, name)):
        raise Damaged(f"{faults[0]}; remove {target} to make it again")


def _run_tasks(root: Path, plan: Plan, task_function: TaskFunction, mapper: Mapper, name: str | None) -> list[Json]:
    """Make the missing partitions (files) of a version, and return the receipts of all partitions.

    A receipt is the JSON record of a finished partition; the order is that of the tasks in the plan. Partitions of
    older versions are reused if possible. Raise TasksFailed if a partition has no receipt at the end.
    """
    table, stage = plan.table, layout.stage_folder(root, plan.table.name, plan.key)
    discard_damaged(stage, plan)
    for version in _candidate_versions(root, table.name, name):
        reuse.link_reusable(stage, version, table.name, missing_tasks(stage, plan))
    remaining = missing_tasks(stage, plan)
    failures: dict[str, str] = {}
    run = partial(run_task, root, plan.key, table, plan.facts, task_function)
    for result in mapper(run, remaining) if remaining else ():
        if "error" in result:
            failures[result["part"]] = result["error"]
    completed = completed_receipts(stage, plan)
    if failed_tasks := [task for task in plan.tasks if task.name not in completed]:
        lines = [f"{task.name}: {failures.get(task.name, 'ended without a receipt')}" for task in failed_tasks]
        raise TasksFailed(
            f"table {table.name}: {len(failed_tasks)} of {len(plan.tasks)} tasks failed: " + "; ".join(lines)
        )
    return [completed[task.name] for task in plan.tasks]


def _candidate_versions(root: Path, table: str, name: str | None) -> list[Path]:
    """Return the folders of published versions of a table that may contain reusable partitions.

    They are the version of the request (named set of settings) `name`, the current version, and the versions of other
    requests. A reusable partition is a file that need not be made again, because its inputs are the same as before.
    """
    keys = [
        _replaced_key(root, table, name),
        current_key(root, table),
        *request_links.keys_by_request(root, table).values(),
    ]
    versions = (layout.version_folder(root, table, key) for key in dict.fromkeys(keys) if key is not None)
    return [path for path in versions if path.exists()]


def _finish_stage(stage: Path, plan: Plan, task_receipts: Sequence[Json]) -> None:
    """Complete the folder of a new version with HATS metadata and the manifest, so that a rename can publish it.

    `task_receipts` are the records of the finished partitions, in the order of the tasks in `plan`. BadInput is raised
    if a primary key occurs in two partitions, Damaged if a file is missing.
    """
    refuse_duplicates(stage, plan, task_receipts)
    entries = {f["path"]: f for receipt in task_receipts for f in receipt["files"]}
    _remove_unlisted(stage, set(entries))
    if plan.table.is_catalogue:
        hats_files.write_metadata(stage, plan.table, task_receipts, receipts_folder(stage))
    rows = {data_path(plan.table, r["part"]): r["rows"] for r in task_receipts}
    files = []
    for path in sorted(stage.rglob("*")):
        relative = path.relative_to(stage).as_posix()
        if manifest.is_temporary(path):
            # Skip files with temporary names: a second process may still be writing a partition that is finished.
            continue
        if path.is_file():
            entry = entries.pop(relative, None)
            if entry is None:
                # The file is not in the record of a partition, so it has not been synced to disc.
                entry = manifest.file_entry(path, relative)
                sync(path)
            files.append({**entry, **({"rows": rows[relative]} if relative in rows else {})})
        else:
            sync(path)
    if entries:
        raise Damaged(f"{stage / min(entries)} is missing")
    deflections = (
        {"deflection_deg": max(r["deflection_deg"] for r in task_receipts)}
        if task_receipts and "deflection_deg" in task_receipts[0]
        else {}
    )
    manifest.write(
        stage,
        {
            "truesky": __version__,
            "table": plan.table.name,
            "version": plan.table.version,
            "key": plan.key,
            "facts": dict(plan.facts),
            "parts": [
                {"name": task.name, "facts": dict(task.facts), **reuse.manifest_facts(task, receipt)}
                for task, receipt in zip(plan.tasks, task_receipts, strict=True)
            ],
            "rows": sum(rows.values()),
            # Types of the machines that made the partitions. On another type, the last bits of numbers may differ.
            "machines": sorted({str(r["machine"]) for r in task_receipts}),
            "files": files,
            **deflections,
        },
    )


def _remove_unlisted(stage: Path, listed: set[str]) -> None:
    """Remove the files in the folder of an unfinished version (`stage`) whose relative paths are not in `listed`.

    They are temporary files of killed tasks, and metadata of an interrupted run.
    """
    for path in sorted(stage.rglob("*"), reverse=True):
        if path.is_file() and path.relative_to(stage).as_posix() not in listed:
            path.unlink(missing_ok=True)


def _publish(root: Path, plan: Plan, base: str | None, name: str | None) -> None:
    table, key = plan.table.name, plan.key
    folder = layout.table_folder(root, table)
    with locks.hold_table(folder):
        replaced_key = _replaced_key(root, table, name)
        if replaced_key not in (base, key):
            raise Superseded(
                f"table {table}: version {replaced_key} was published since this run began from {base}; "
                "run again to replace it"
            )
        stage, target = layout.stage_folder(root, table, key), layout.version_folder(root, table, key)
        if not target.exists():
            os.rename(stage, target)
            sync(folder)
        if name is not None and replaced_key != key:
            request_links.link_version(root, name, table, key)
        if current_key(root, table) != key:
            request_links.replace_link(layout.current_link(root, table), target.name)
    shutil.rmtree(receipts_folder(stage), ignore_errors=True)
    (folder / f".lock-{key}").unlink(missing_ok=True)
