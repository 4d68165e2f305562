"""Check that no primary key, such as the identifier of a source, occurs in two partitions (files) of a table."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from lake_schema.arrays import Int
from lake_schema.columns import Table
from lake_schema.errors import BadInput
from lake_schema.ids import BLOCK_BITS
from lake_schema.store import parquet
from lake_schema.store.plan import Json, Plan
from lake_schema.store.stage import is_numbered


def refuse_duplicates(stage: Path, plan: Plan, receipts: Sequence[Json]) -> None:
    """Raise BadInput if a primary key occurs in two partitions (files) of a version of a table.

    Parameters
    ----------
    stage : Path
        Folder of the version that is being made.
    plan : Plan
        Plan of the version, which contains the declaration of the table.
    receipts : sequence of mapping
        Receipts (JSON records of files and ranges of keys) of all partitions.

    Raises
    ------
    BadInput
        If a key occurs in two partitions. The message names the key and both files.

    Notes
    -----
    Duplicates within a partition are not found here; `stage.write_partition` refuses them. To save time, only
    partitions with identifiers in the same block (the high bits of an identifier), or with overlapping ranges of keys,
    are read.
    """
    table = plan.table
    # The first file in a receipt (record of a partition) is the Parquet file; the others are images, for example.
    entries = {receipt["files"][0]["path"]: receipt["files"][0] for receipt in receipts}
    if not is_numbered(table):
        for group in _overlapping_groups(receipts):
            _refuse_shared_keys(stage, table, [receipt["files"][0] for receipt in group])
        return

    @lru_cache(maxsize=16)
    def sorted_ids(path: str) -> Int:
        return np.sort(parquet.read(stage, entries[path], table.key).column(0).to_numpy())

    for block, files in _shared_blocks(receipts, list(entries)).items():
        _refuse_shared_ids(f"table {table.name}: {table.key[0]}", block, files, sorted_ids)


def _shared_blocks(receipts: Sequence[Json], paths: Sequence[str]) -> dict[int | None, list[str]]:
    """Return the paths of the files that contain identifiers of the same block, by block number.

    A block is the range of identifiers with the same high bits. Blocks that occur in one file only are left out. If the
    receipt (record) of any file does not list its blocks, the result is {None: all paths}.
    """
    if any(receipt["blocks"] is None for receipt in receipts):
        return {None: list(paths)}
    holders: dict[int | None, list[str]] = defaultdict(list)
    for receipt, path in zip(receipts, paths, strict=True):
        for block in receipt["blocks"]:
            holders[block].append(path)
    return {block: files for block, files in holders.items() if len(files) > 1}


def _refuse_shared_ids(
    column_label: str, block: int | None, files: Sequence[str], sorted_ids: Callable[[str], Int]
) -> None:
    pieces = [sorted_ids(path) for path in files]
    if block is not None:
        edges = np.array([block, block + 1]) << BLOCK_BITS
        pieces = [piece[slice(*np.searchsorted(piece, edges))] for piece in pieces]
    all_ids = np.concatenate(pieces)
    order = np.argsort(all_ids, kind="stable")
    same = np.flatnonzero(np.diff(all_ids[order]) == 0)
    if same.size:
        source = np.repeat(np.arange(len(files)), [piece.size for piece in pieces])
        first, second = (PurePosixPath(files[source[order[same[0] + i]]]).name for i in (0, 1))
        raise BadInput(f"{column_label} {all_ids[order[same[0]]]} is in {first} and in {second}")


def _overlapping_groups(receipts: Sequence[Json]) -> Iterator[list[Json]]:
    """Yield groups of two or more receipts (records of partitions) whose ranges of primary keys overlap.

    Receipts of partitions without rows have no range and are ignored.
    """
    group: list[Json] = []
    highest: list[Any] = []
    for receipt in sorted(
        (candidate for candidate in receipts if candidate["span"]), key=lambda receipt: receipt["span"][0]
    ):
        lowest, high = receipt["span"]
        if group and _is_below(highest, lowest):
            if len(group) > 1:
                yield group
            group = []
        # A bound is a list of values of the leading key columns. If one bound is the beginning of another one, the
        # shorter bound covers more keys and is kept.
        if not group or _is_below(highest, high) or (not _is_below(high, highest) and len(high) < len(highest)):
            highest = high
        group.append(receipt)
    if len(group) > 1:
        yield group


def _is_below(first: Sequence[Any], second: Sequence[Any]) -> bool:
    length = min(len(first), len(second))
    return list(first[:length]) < list(second[:length])


def _refuse_shared_keys(stage: Path, table: Table, entries: Sequence[Json]) -> None:
    file_by_key: dict[tuple[object, ...], str] = {}
    for entry in entries:
        columns, file_name = parquet.read(stage, entry, table.key), PurePosixPath(entry["path"]).name
        for value in zip(*(columns[k].to_pylist() for k in table.key), strict=True):
            if value in file_by_key:
                raise BadInput(f"table {table.name}: key {value} is in {file_by_key[value]} and in {file_name}")
            file_by_key[value] = file_name
