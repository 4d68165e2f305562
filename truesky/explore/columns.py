"""Store columns or expressions of a lake as float32 files in the cache, from which charts are counted.

A join returns its rows in a different order each time, so one query fills all its columns. Columns of a table are
filled one by one. Each is stored with a sum over the keys of its rows that depends on their order; columns whose sums
differ are not combined.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Array, Float32
from truesky.numerics import cache
from truesky.numerics.code_fingerprints import code_key

# Function of a query and of texts that must each be an expression; it returns the rows.
Ask = Callable[[str, Sequence[str]], Iterable[pa.RecordBatch]]
_NAME = "columns"
_ORDER = "order"
MAX_BYTES = 4e9


@dataclass(frozen=True, slots=True)
class Selection:
    """Rows of a lake.

    Attributes
    ----------
    lake : str
        Key of the versions of its tables.
    source : str
        SQL after FROM.
    where : str
        SQL condition of the rows.
    keys : tuple of str
        Columns that identify the rows of a table; () if the source is not a table or has no keys.
    part : int
        One row in this number is selected, by its keys.
    """

    lake: str
    source: str
    where: str = "true"
    keys: tuple[str, ...] = ()
    part: int = 1

    def condition(self) -> str:
        """Return the SQL condition of the selected rows."""
        sampled = f" AND hash({', '.join(self.keys)}) % {self.part} = 0" if self.part > 1 else ""
        return f"({self.where}\n){sampled}"


def load(selection: Selection, expressions: Sequence[str], ask: Ask) -> list[Float32]:
    """Load columns, or query and store them if they are not in the cache.

    Parameters
    ----------
    selection : Selection
        Rows.
    expressions : sequence of str
        SQL expressions.
    ask : callable
        Function that runs a query; it raises BadInput if a text is not an expression.

    Returns
    -------
    list of float32 arrays, shape (n,)
        Values of each expression for the same rows, NaN if missing; memory-mapped files.
    """
    if selection.keys:
        loaded = [_cached_columns(selection, [text], ask) for text in expressions]
        if len({int(column[_ORDER][0]) for column in loaded}) <= 1:
            return [column["0"] for column in loaded]
    joint = _cached_columns(selection, expressions, ask)
    return [joint[str(number)] for number in range(len(expressions))]


def _cached_columns(selection: Selection, expressions: Sequence[str], ask: Ask) -> dict[str, Array]:
    key_parts: tuple[str | int, ...] = (
        selection.lake,
        selection.source,
        selection.where,
        *selection.keys,
        selection.part,
    )
    key = cache.content_key(code_key(__name__), *key_parts, "of", *expressions)
    return cache.cached_arrays(_NAME, key, lambda: _compute_columns(selection, expressions, ask))


def _compute_columns(selection: Selection, expressions: Sequence[str], ask: Ask) -> dict[str, Array]:
    select_list = [f"TRY_CAST(({text}\n) AS FLOAT) AS v{number}" for number, text in enumerate(expressions)]
    order = f"hash({', '.join(selection.keys)})" if selection.keys else "0::UBIGINT"
    query = f"SELECT {', '.join(select_list)}, {order} AS row_key FROM {selection.source} WHERE {selection.condition()}"
    cache.cache_dir().mkdir(parents=True, exist_ok=True)
    # Columns of large tables can have gigabytes, so they go to disc and not to memory.
    with ExitStack() as open_files:
        files = [open_files.enter_context(tempfile.TemporaryFile(dir=cache.cache_dir())) for _ in expressions]
        return _collect_batches(ask(query, [*expressions, selection.where]), files)


def _collect_batches(batches: Iterable[pa.RecordBatch], files: Sequence[IO[bytes]]) -> dict[str, Array]:
    """Write columns to files, and sum the keys in the last column in a way that depends on the order of rows."""
    total, rows = np.zeros(1, np.uint64), 0
    for batch in batches:
        for number, file in enumerate(files):
            file.write(batch.column(number).to_numpy(zero_copy_only=False).astype(np.float32).tobytes())
        places = np.arange(rows + 1, rows + 1 + batch.num_rows, dtype=np.uint64)
        total += np.sum(places * batch.column(len(files)).to_numpy(), dtype=np.uint64)
        rows += batch.num_rows
    arrays: dict[str, Array] = {_ORDER: np.append(total, np.uint64(rows))}
    for number, file in enumerate(files):
        file.flush()
        arrays[str(number)] = np.memmap(file, np.float32, "r", shape=(rows,)) if rows else np.zeros(0, np.float32)
    return arrays


def trim(max_bytes: float = MAX_BYTES, folder: Path | None = None) -> int:
    """Remove stored columns, the oldest first, until at most `max_bytes` bytes remain; return their number.

    `folder` is the cache folder; None is the cache of the project.
    """
    folders = [path for path in (folder or cache.cache_dir()).glob(f"{_NAME}-*") if path.is_dir()]
    sizes = {path: sum(file.stat().st_size for file in path.iterdir()) for path in folders}
    removed, total = 0, sum(sizes.values())
    for path in sorted(folders, key=_age):
        if total <= max_bytes:
            break
        shutil.rmtree(path, ignore_errors=True)
        removed, total = removed + 1, total - sizes[path]
    return removed


def _age(folder: Path) -> float:
    return folder.stat().st_mtime
