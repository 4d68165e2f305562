"""Make single partitions (Parquet files) of a version of a table, with a receipt for each.

A partition is made in the stage, the hidden folder of a version that is not published yet. Its rows are checked, its
files are written, and its receipt is written last. A receipt is a JSON record of the files with their sizes and
checksums. A task (the work for one partition) is done if its receipt exists and its files have the recorded sizes; at
the start of a run, the sha256 of the files are compared, too. Spark may run two copies of a task at the same time, and
one of them may end after the run.
"""

from __future__ import annotations

import json
import os
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema import instruction_set, sky
from lake_schema.columns import Table
from lake_schema.errors import BadInput, LakeError, Superseded
from lake_schema.ids import BLOCK_BITS, kind_from_id
from lake_schema.store import hats_files, layout, manifest, parquet
from lake_schema.store.plan import Json, Output, Plan, Task, TaskFunction, data_path
from lake_schema.store.provenance import digest, file_sha256, machine
from lake_schema.store.validate import check_rows

# Largest number of blocks of identifiers (order-8 HEALPix cells, each for one type of source) that the receipt (record)
# of a partition lists. An order-3 cell, the largest partition, has 1024 blocks per type of source.
_MAX_BLOCKS = 4096
# Key of a receipt with the sha256 of its other entries.
_DIGEST = "digest"
# Number of receipts (records of finished partitions) that are read in parallel, because each read on a network file
# system has a long delay.
_READ_THREADS = 16


def run_task(root: Path, key: str, table: Table, facts: Json, task_function: TaskFunction, task: Task) -> Json:
    """Make and write one partition (Parquet file) of a version, unless it exists already.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    key : str
        Key of the version that is being made.
    table : Table
        Declaration of the table.
    facts : mapping
        Everything that determines the contents of all partitions: settings, inputs, code.
    task_function : callable
        Function of (folder of the lake, facts of the plan and of the task in one dict) that returns an Output.
    task : Task
        Name and facts of the partition.

    Returns
    -------
    mapping
        The receipt (JSON record of the files and rows that were written). After a failure instead the entries "part"
        (name of the partition), "error" (message), "traceback", and "final": True if the same input will fail again.

    Raises
    ------
    Superseded
        Only inside the function, which catches every Exception and returns it as a failure.
    """
    stage = layout.stage_folder(root, table.name, key)
    if is_done(stage, task):
        return read_receipt(stage, task.name) or {}
    try:
        instruction_set.require_limit()
        output = task_function(root, {**facts, **task.facts})
        if is_done(stage, task):
            # Spark may have started a second copy of this task, which finished while the function above ran.
            return read_receipt(stage, task.name) or {}
        if not stage.is_dir():
            raise Superseded(f"table {table.name}: version {key} was published before this copy of {task.name} ended")
        return write_partition(stage, table, task, output)
    except Exception as error:
        is_refusal = isinstance(error, LakeError)
        line = str(error) if is_refusal else f"{type(error).__name__}: {error}"
        return {"part": task.name, "error": line, "traceback": traceback.format_exc(), "final": is_refusal}


def write_partition(stage: Path, table: Table, task: Task, output: Output) -> Json:
    """Check the rows of one partition, and write its files and then its receipt (JSON record of these files).

    Parameters
    ----------
    stage : Path
        Folder of the version that is being made.
    table : Table
        Declaration of the table.
    task : Task
        Name of the partition, and the number of rows that it must have.
    output : Output
        Rows and further files of the partition.

    Returns
    -------
    mapping
        The receipt: name, number of rows, machine type, and path, size and checksums of each file.

    Raises
    ------
    BadInput
        If `output` is not an Output, the number of rows is wrong, the rows do not agree with the declaration, or rows
        of a catalogue are not sorted or are outside the HEALPix cell of the partition.
    OSError
        If a file cannot be written.
    """
    if not isinstance(output, Output):
        kind = type(output).__name__
        raise BadInput(f"table {table.name}: the task function of {task.name} must return an Output, got {kind}")
    rows = output.rows
    if task.rows is not None and rows.num_rows != task.rows:
        raise BadInput(f"table {table.name}: {task.name} must have {task.rows} rows by the plan, got {rows.num_rows}")
    check_rows(rows, table)
    if table.is_catalogue:
        _check_positions(rows, table, task)
    path = data_path(table, task.name)
    writers = {path: lambda target: parquet.write(target, rows, table), **output.files}
    files = [_write_file(stage, relative, writer) for relative, writer in writers.items()]
    receipt: dict[str, Any] = {"part": task.name, "rows": rows.num_rows, "files": files, "machine": machine()}
    receipt |= _summarize_rows(rows, table)
    if table.is_catalogue and table.pixel_order is None:
        border_rows = hats_files.border_rows(rows, task.name)
        receipt["border"] = _write_file(
            receipts_folder(stage), _flat_name(task.name), lambda target: parquet.write(target, border_rows, table)
        )
    write_receipt(stage, receipt)
    return receipt


def write_receipt(stage: Path, receipt: Json) -> None:
    """Write the receipt of a partition, a JSON record of its files with sizes and checksums, and its own digest.

    It is written into a folder next to `stage`, the folder in which the version is made.
    """
    manifest.write_json(_receipt_path(stage, receipt["part"]), {**receipt, _DIGEST: digest(receipt)})


def _check_positions(rows: pa.Table, table: Table, task: Task) -> None:
    index = rows["_healpix_29"].to_numpy()
    if not index.size:
        return
    where = f"table {table.name}: {task.name}"
    if (index[1:] < index[:-1]).any():
        raise BadInput(f"{where}: rows are not sorted by _healpix_29")
    first, last = sky.cell_range(*layout.cell_of_file(task.name))
    if index[0] < first or index[-1] >= last:
        raise BadInput(f"{where} holds rows of another cell")
    if table.pixel_order is None:
        expected, source = sky.healpix_29(rows["ra"].to_numpy(), rows["dec"].to_numpy()), "ra, dec"
    else:
        expected, source = rows["pixel"].to_numpy() << 2 * (sky.MAX_ORDER - table.pixel_order), "pixel"
    wrong = index != expected
    if wrong.any():
        raise BadInput(f"{where}: _healpix_29 of row {wrong.argmax()} does not match its {source}")
    if "kind" in table.names:
        wrong = kind_from_id(rows["id"].to_numpy()) != rows["kind"].to_numpy()
        if wrong.any():
            raise BadInput(f"{where}: kind of row {wrong.argmax()} does not match its id")


def _summarize_rows(rows: pa.Table, table: Table) -> dict[str, Any]:
    """Return values about the rows of a partition, for the JSON record of the finished partition.

    "blocks" lists the high bits of the identifiers that occur, or is None if there are too many. If the primary key is
    not one integer column, "span" is the range of primary keys instead. For a table with observed and true positions,
    "deflection_deg" is the largest distance between them (deg).
    """
    facts: dict[str, Any] = {}
    if is_numbered(table):
        blocks = np.unique(rows[table.key[0]].to_numpy() >> BLOCK_BITS)
        facts["blocks"] = blocks.tolist() if blocks.size <= _MAX_BLOCKS else None
    else:
        facts["span"] = _key_span(rows, table)
    if "ra_true" in table.names:
        positions = (rows[name].to_numpy() for name in ("ra", "dec", "ra_true", "dec_true"))
        facts["deflection_deg"] = float(sky.separation(*positions).max(initial=0.0))
    return facts


def _key_span(rows: pa.Table, table: Table) -> list[list[Any]]:
    """Return the lowest and highest primary key of the rows, shortened, or [] without rows.

    Each is a list of values of the key's columns, up to and including the first column that is not constant.
    """
    lowest: list[Any] = []
    highest: list[Any] = []
    for name in table.key if rows.num_rows else ():
        bounds = pc.min_max(rows[name]).as_py()
        lowest.append(bounds["min"])
        highest.append(bounds["max"])
        if lowest != highest:
            break
    return [lowest, highest] if lowest else []


def is_numbered(table: Table) -> bool:
    """Return True if the primary key of a table is one int64 column, such as the identifiers of sources."""
    return len(table.key) == 1 and table.column(table.key[0]).type == "int64"


def _write_file(folder: Path, relative: str, writer: Callable[[Path], None]) -> Json:
    target = layout.check_inside(folder, folder / relative)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = manifest.temporary_path(target)
    try:
        writer(temporary)
        manifest.sync(temporary)
        facts = manifest.file_entry(temporary, relative)
        os.replace(temporary, target)
        manifest.sync(target.parent)
    finally:
        temporary.unlink(missing_ok=True)
    return facts


# ------------------------------------- receipts: JSON records of finished partitions


def receipts_folder(stage: Path) -> Path:
    """Return the folder with one receipt (JSON file) per finished partition of a version that is being made.

    `stage` is the folder in which the version is made; the folder of receipts is next to it.
    """
    return stage.with_name(stage.name.replace(".stage-", ".receipts-"))


def refuse_links(stage: Path) -> None:
    """Raise BadInput if the folder of an unfinished version, or that of its receipts, is or contains a symbolic link.

    truesky makes no such links. A link in the lake of a stranger could lead out of the lake, and files would be
    written and removed there.
    """
    for folder in (stage, receipts_folder(stage)):
        if link := next((path for path in (folder, *folder.rglob("*")) if path.is_symlink()), None):
            raise BadInput(f"{link} is a symbolic link, and an unfinished version must not have one: remove it")


def _receipt_path(stage: Path, partition: str) -> Path:
    return receipts_folder(stage) / f"{_flat_name(partition)}.json"


def _flat_name(partition: str) -> str:
    return partition.replace("/", "+")


def read_receipt(stage: Path, partition: str) -> dict[str, Any] | None:
    """Return the receipt (record of the written files) of a partition, or None if it is missing or damaged.

    The partition is then made again. The manifest takes the checksums and numbers of rows from the receipt.
    """
    try:
        receipt: dict[str, Any] = json.loads(_receipt_path(stage, partition).read_bytes())
        is_whole = receipt.pop(_DIGEST) == digest(receipt)
    except (FileNotFoundError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return None
    return receipt if is_whole else None


def is_done(stage: Path, task: Task) -> bool:
    """Return True if a partition is finished: its receipt exists, and all files in it have the recorded sizes."""
    receipt = read_receipt(stage, task.name)
    if receipt is None:
        return False
    sizes = [(stage / f["path"], f["bytes"]) for f in receipt["files"]]
    if "border" in receipt:
        sizes.append((receipts_folder(stage) / receipt["border"]["path"], receipt["border"]["bytes"]))
    return all(path.is_file() and path.stat().st_size == size for path, size in sizes)


def completed_receipts(stage: Path, plan: Plan) -> dict[str, Json]:
    """Return the receipts (records of the written files) of all finished partitions, by name of the partition.

    `plan` describes the version of a table that is being made, with one task per partition.
    """
    folder = receipts_folder(stage)
    receipt_names = {entry.name for entry in os.scandir(folder)} if folder.is_dir() else set()
    candidates = [task for task in plan.tasks if f"{_flat_name(task.name)}.json" in receipt_names]
    with ThreadPoolExecutor(_READ_THREADS) as pool:
        receipts = pool.map(lambda task: read_receipt(stage, task.name) if is_done(stage, task) else None, candidates)
        return {task.name: receipt for task, receipt in zip(candidates, receipts, strict=True) if receipt is not None}


def missing_tasks(stage: Path, plan: Plan) -> list[Task]:
    """Return the tasks of a plan whose partitions are not finished, in the order of the plan.

    `plan` describes the version of a table that is being made in the folder `stage`, with one task per partition.
    """
    completed = completed_receipts(stage, plan)
    return [task for task in plan.tasks if task.name not in completed]


def discard_damaged(stage: Path, plan: Plan) -> None:
    """Remove the receipts of partitions whose files differ from the recorded sha256, so that they are made again."""
    completed = completed_receipts(stage, plan)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for name, is_intact in zip(completed, pool.map(lambda name: _is_intact(stage, name), completed), strict=True):
            if not is_intact:
                _receipt_path(stage, name).unlink(missing_ok=True)


def _is_intact(stage: Path, partition: str) -> bool:
    receipt = read_receipt(stage, partition) or {"files": []}
    files = [(stage / f["path"], f["sha256"]) for f in receipt["files"]]
    if "border" in receipt:
        files.append((receipts_folder(stage) / receipt["border"]["path"], receipt["border"]["sha256"]))
    return bool(files) and all(file_sha256(path) == sha256 for path, sha256 in files)
