"""One part of a version: checked, written, hashed, its receipt last.  Everything here runs wherever the map runs it.

A part is done when its receipt is there and its files have the sizes that it says; where a run begins, their sha256.
Two copies of a task may run at a time, on machines of one kind, and one of them longer than the run.
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
from lake_schema.ids import BLOCK_BITS, kind_of
from lake_schema.store import hats_files, layout, manifest, parquet
from lake_schema.store.plan import Json, Output, Part, Plan, Work, data_path
from lake_schema.store.provenance import file_sha256, machine
from lake_schema.store.validate import check

# A part whose identifiers spread over more blocks than this has none worth noting (order 3 has 1024 of a kind).
_MOST_BLOCKS = 4096
# Receipts that are looked at at once: what a file system on the network takes is waited for.
_AT_ONCE = 16


def attempt(root: Path, key: str, table: Table, facts: Json, work: Work, part: Part) -> Json:
    """Make and write one part, if it is not done yet; a failure comes back as {"part", "error", "traceback", "final"}.

    final : the same input will fail again
    root, key   : folder of the lake, key of the version;  table : its declaration;  part : of the plan
    facts, work : of the plan, and what makes a part's Output of them and the part's own
    """
    stage = layout.stage(root, table.name, key)
    if is_done(stage, part):
        return receipt_of(stage, part.name) or {}
    try:
        instruction_set.require_limit()
        output = work(root, {**facts, **part.facts})
        if is_done(stage, part):
            # Another copy of this task was faster.
            return receipt_of(stage, part.name) or {}
        if not stage.is_dir():
            raise Superseded(f"table {table.name}: version {key} was published before {part.name} was made once more")
        return write_part(stage, table, part, output)
    except Exception as error:
        refused = isinstance(error, LakeError)
        line = str(error) if refused else f"{type(error).__name__}: {error}"
        return {"part": part.name, "error": line, "traceback": traceback.format_exc(), "final": refused}


def write_part(stage: Path, table: Table, part: Part, output: Output) -> Json:
    """Write one part into the stage, its receipt last; returns the receipt.

    stage  : folder of the version that is being made;  table : its declaration
    part   : of the plan;  output : its rows and further files
    Errors: BadInput where the rows are not what the table declares or the plan wants; OSError where the disc refuses
    """
    if not isinstance(output, Output):
        raise BadInput(f"table {table.name}: the maker of {part.name} returned {type(output).__name__}, not an Output")
    rows = output.rows
    if part.rows is not None and rows.num_rows != part.rows:
        raise BadInput(f"table {table.name}: {part.name} has {rows.num_rows} rows, the plan says {part.rows}")
    check(rows, table)
    if table.is_catalogue:
        _check_sky(rows, table, part)
    path = data_path(table, part.name)
    writers = {path: lambda target: parquet.write(target, rows, table), **output.files}
    files = [_write_file(stage, relative, writer) for relative, writer in writers.items()]
    receipt: dict[str, Any] = {"part": part.name, "rows": rows.num_rows, "files": files, "machine": machine()}
    receipt |= _row_facts(rows, table)
    if table.is_catalogue:
        kept = hats_files.border(rows, part.name)
        receipt["border"] = _write_file(
            receipts(stage), _flat(part.name), lambda target: parquet.write(target, kept, table)
        )
    write_receipt(stage, receipt)
    return receipt


def write_receipt(stage: Path, receipt: Json) -> None:
    """Put a part's receipt into its place."""
    manifest.write_json(_receipt_path(stage, receipt["part"]), receipt)


def _check_sky(rows: pa.Table, table: Table, part: Part) -> None:
    index = rows["_healpix_29"].to_numpy()
    if not index.size:
        return
    where = f"table {table.name}: {part.name}"
    if (index[1:] < index[:-1]).any():
        raise BadInput(f"{where}: rows are not sorted by _healpix_29")
    first, last = sky.cell_range(*layout.cell_of_file(part.name))
    if index[0] < first or index[-1] >= last:
        raise BadInput(f"{where} holds rows of another cell")
    wrong = index != sky.healpix_29(rows["ra"].to_numpy(), rows["dec"].to_numpy())
    if wrong.any():
        raise BadInput(f"{where}: _healpix_29 of row {wrong.argmax()} is not that of its ra, dec")
    if "kind" in table.names:
        wrong = kind_of(rows["id"].to_numpy()) != rows["kind"].to_numpy()
        if wrong.any():
            raise BadInput(f"{where}: kind of row {wrong.argmax()} is not that of its id")


def _row_facts(rows: pa.Table, table: Table) -> dict[str, Any]:
    """What the driver must know of a part's rows: blocks of its identifiers or the span of its keys, the largest
    deflection.
    """
    facts: dict[str, Any] = {}
    if is_numbered(table):
        blocks = np.unique(rows[table.key[0]].to_numpy() >> BLOCK_BITS)
        facts["blocks"] = blocks.tolist() if blocks.size <= _MOST_BLOCKS else None
    else:
        facts["span"] = _span(rows, table)
    if "ra_true" in table.names:
        places = (rows[name].to_numpy() for name in ("ra", "dec", "ra_true", "dec_true"))
        facts["deflection_deg"] = float(sky.separation(*places).max(initial=0.0))
    return facts


def _span(rows: pa.Table, table: Table) -> list[list[Any]]:
    """Lowest and highest value of the key's first columns, as far as they are the same in all rows and one on."""
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
    """Is a row identified by one integer?"""
    return len(table.key) == 1 and table.column(table.key[0]).type == "int64"


def _write_file(folder: Path, relative: str, writer: Callable[[Path], None]) -> Json:
    target = layout.within(folder, folder / relative)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = manifest.temporary(target)
    try:
        writer(temporary)
        manifest.sync(temporary)
        facts = manifest.file_facts(temporary, relative)
        os.replace(temporary, target)
        manifest.sync(target.parent)
    finally:
        temporary.unlink(missing_ok=True)
    return facts


# ------------------------------------------------------------------------------------------------ receipts


def receipts(stage: Path) -> Path:
    """Folder of a stage's receipts, one JSON file a part that is done."""
    return stage.with_name(stage.name.replace(".stage-", ".receipts-"))


def _receipt_path(stage: Path, part: str) -> Path:
    return receipts(stage) / f"{_flat(part)}.json"


def _flat(part: str) -> str:
    return part.replace("/", "+")


def receipt_of(stage: Path, part: str) -> dict[str, Any] | None:
    """A part's receipt, None where there is none that can be read."""
    try:
        receipt: dict[str, Any] = json.loads(_receipt_path(stage, part).read_bytes())
    except (FileNotFoundError, ValueError):
        return None
    return receipt


def is_done(stage: Path, part: Part) -> bool:
    """Is the part's receipt there, and are its files, at the sizes that it says?"""
    receipt = receipt_of(stage, part.name)
    if receipt is None:
        return False
    sizes = [(stage / f["path"], f["bytes"]) for f in receipt["files"]]
    if "border" in receipt:
        sizes.append((receipts(stage) / receipt["border"]["path"], receipt["border"]["bytes"]))
    return all(path.is_file() and path.stat().st_size == size for path, size in sizes)


def done(stage: Path, plan: Plan) -> dict[str, Json]:
    """Receipts of the parts that are done, by name."""
    folder = receipts(stage)
    there = {entry.name for entry in os.scandir(folder)} if folder.is_dir() else set()
    some = [part for part in plan.parts if f"{_flat(part.name)}.json" in there]
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        found = pool.map(lambda part: receipt_of(stage, part.name) if is_done(stage, part) else None, some)
        return {part.name: receipt for part, receipt in zip(some, found, strict=True) if receipt is not None}


def missing(stage: Path, plan: Plan) -> list[Part]:
    """Parts of the plan that are not done."""
    made = done(stage, plan)
    return [part for part in plan.parts if part.name not in made]


def forget_damaged(stage: Path, plan: Plan) -> None:
    """Remove the receipts of parts whose files do not have the sha256 that they say."""
    made = done(stage, plan)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for name, whole in zip(made, pool.map(lambda name: _is_whole(stage, name), made), strict=True):
            if not whole:
                _receipt_path(stage, name).unlink(missing_ok=True)


def _is_whole(stage: Path, part: str) -> bool:
    receipt = receipt_of(stage, part) or {"files": []}
    files = [(stage / f["path"], f["sha256"]) for f in receipt["files"]]
    if "border" in receipt:
        files.append((receipts(stage) / receipt["border"]["path"], receipt["border"]["sha256"]))
    return bool(files) and all(file_sha256(path) == sha256 for path, sha256 in files)
