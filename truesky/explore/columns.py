"""Store the values of SQL expressions as float32 files in the disc cache, so that histograms of them need no query.

A histogram (chart) can combine several columns, so all columns must have their rows in the same order. Columns of a
single table are queried and stored one by one. Each is stored with a checksum of the order of its rows, computed from
the primary keys. If the checksums of columns differ, one query computes all these columns again together. A join
returns its rows in a different order each time, and its columns have no checksum. They are therefore always queried
together.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Array, Float32
from truesky.numerics import cache, cache_entries
from truesky.numerics.code_fingerprints import code_key

# Type of a function that runs a query. Its arguments are the SQL of the query, and the parts of this SQL that a user
# wrote, each of which must be exactly one SQL expression. It returns the rows in batches.
Ask = Callable[[str, Sequence[str]], Iterable[pa.RecordBatch]]
_NAME = "columns"
_ORDER = "order"
MAX_BYTES = 4e9


@dataclass(frozen=True, slots=True)
class Selection:
    """Selection of rows from the tables of a lake.

    Attributes
    ----------
    lake : str
        Digest that identifies the lake and the versions of its tables; it changes if their content changes.
    source : str
        Name of a table, or other SQL after FROM such as a join.
    where : str
        SQL condition that the rows must meet.
    keys : tuple of str
        Columns that identify a row of the table; () if the source is not a single table, or has no such columns.
    part : int
        Sampling factor: about one row in `part` is selected, by a hash of its keys; 1 selects all rows. Larger values
        require `keys`.
    """

    lake: str
    source: str
    where: str = "true"
    keys: tuple[str, ...] = ()
    part: int = 1

    def condition(self) -> str:
        """Return the SQL condition that the selected rows meet: `where`, and the sampling if `part` is above 1."""
        sampled = f" AND hash({', '.join(self.keys)}) % {self.part} = 0" if self.part > 1 else ""
        return f"({self.where}\n){sampled}"


def load(selection: Selection, expressions: Sequence[str], ask: Ask) -> list[Float32]:
    """Return the values of SQL expressions for selected rows, from the cache if they are in it.

    Missing values are computed with a query and stored in the cache.

    Parameters
    ----------
    selection : Selection
        Rows to select.
    expressions : sequence of str
        SQL expressions, one per column.
    ask : callable
        Function that runs a query. Its arguments are the SQL, and the parts of it that a user wrote. It must raise
        BadInput if one of these parts is not exactly one SQL expression.

    Returns
    -------
    list of float32 arrays, shape (n,)
        Values of each expression as memory-mapped files. The order of rows is the same in all arrays. Values are NaN if
        they are NULL or cannot be converted to a number.
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
    # Columns of large tables can have gigabytes, so they are written to temporary files and not held in memory.
    with ExitStack() as open_files:
        files = [open_files.enter_context(tempfile.TemporaryFile(dir=cache.cache_dir())) for _ in expressions]
        return _collect_batches(ask(query, [*expressions, selection.where]), files)


def _collect_batches(batches: Iterable[pa.RecordBatch], files: Sequence[IO[bytes]]) -> dict[str, Array]:
    """Write each column but the last to its file as float32, and return the columns with a checksum of the row order.

    The last column contains a uint64 hash of each row's key. The checksum is the sum of row number times hash, modulo
    2^64, so it depends on the order of the rows. It is stored under "order" with the number of rows. The columns are
    memory-mapped, and their names in the result are "0", "1", ...
    """
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
    """Remove stored columns (values of SQL expressions) from the disc cache until at most `max_bytes` bytes remain.

    The least recently used columns are removed first, also those that this process uses: it keeps their memory maps.
    Return the number of removed entries (folders of one or several columns). `folder` is the cache folder; None means
    the cache folder of truesky.
    """
    root = folder or cache.cache_dir()
    stored = [entry for entry in cache_entries.entries(root) if entry.folder.name.startswith(f"{_NAME}-")]
    removed, total = 0, sum(entry.size for entry in stored)
    for entry in stored:
        if total <= max_bytes:
            break
        cache_entries.remove(entry.folder, root)
        removed, total = removed + 1, total - entry.size
    return removed
