"""Program of the separate process that runs SQL queries: python -m truesky.explore.worker LAKE MEMORY TABLE=KEY ...

Queries run in a separate process, because a process has a strict memory limit and can be killed. DuckDB does not count
the memory of every function and of the result, and some of its functions cannot be interrupted.

The process reads each query as one line of JSON from stdin, and writes the answer to stdout. An answer begins with a
line of JSON that contains the number `id` of the query, and the error if the query failed. If it succeeded, an Arrow
stream with the rows follows, and then a second line of JSON. The second line contains `id` again, and an error if the
stream is incomplete.
"""

from __future__ import annotations

import itertools
import json
import os
import sys
from collections.abc import Iterator, Sequence
from typing import IO, TYPE_CHECKING, Any

import pyarrow as pa

from lake_schema import command
from lake_schema.errors import BadInput, Damaged, LakeError
from lake_schema.pandas_import import hide_pandas
from lake_schema.store import layout
from truesky.explore.guard import TOO_LARGE

if TYPE_CHECKING:
    from truesky.explore.session import Session

# Memory in bytes that Python and the libraries need before any query; it is added to the memory limit of queries.
_BASE_BYTES = 1 << 30
# Batches of more bytes than this are divided before they are sent; a single row is never divided.
_PIECE_BYTES = 8 << 20
# Largest size of a single row in bytes, if the query has no limit for the size of its result.
_MAX_ROW_BYTES = 64 << 20


def main(argv: Sequence[str]) -> int:
    """Answer queries until stdin ends, and return the exit status 0.

    `argv` contains the lake, the memory limit of a query in bytes, and one entry per table. An entry is TABLE=KEY or
    REQUEST.TABLE=KEY with the key of the table's version (a hash of everything that determines its content).
    TABLE=?REQUEST means a table that could not be opened, so that a query of this table raises the error. TABLE=@FILE
    means the rows of an Arrow file.
    """
    hide_pandas()
    # This import must come after `hide_pandas`.
    from truesky.explore.session import Session

    root, memory = layout.open_lake(argv[0]), int(argv[1])
    command.limit_resource("RLIMIT_DATA", memory + _BASE_BYTES)
    command.limit_resource("RLIMIT_CORE", 0)
    session = Session(root, dict(entry.split("=", 1) for entry in argv[2:]), memory)
    # Answers go to a copy of stdout. Descriptor 1 is redirected to stderr, so that text that a library prints cannot
    # get between the answers.
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    for line in sys.stdin:
        _answer(out, session, json.loads(line))
    return 0


def _answer(out: IO[bytes], session: Session, question: dict[str, Any]) -> None:
    header, fault = {"id": question["id"]}, dict[str, str]()
    batches = _batches(session, question)
    try:
        # The first batch is empty, and errors in the query are raised before the second one. Two batches are read
        # before anything is written, so that a wrong query is answered by its error alone.
        first = list(itertools.islice(batches, 2))
        out.write(json.dumps(header).encode() + b"\n")
        with pa.ipc.new_stream(out, first[0].schema) as stream:
            try:
                for batch in itertools.chain(first, batches):
                    stream.write_batch(batch)
            except (LakeError, MemoryError) as error:
                fault = _error_fields(error)
    except (LakeError, MemoryError) as error:
        fault = _error_fields(error)
    out.write(json.dumps(header | fault).encode() + b"\n")
    out.flush()


def _batches(session: Session, question: dict[str, Any]) -> Iterator[pa.RecordBatch]:
    """Yield the result of a query in Arrow batches.

    The keys `rows` and `bytes` of `question` are optional limits. Rows after the first `rows` are not returned.
    BadInput is raised if the result has more than `bytes` bytes, or the query is not allowed.
    """
    max_rows, max_bytes = question.get("rows"), question.get("bytes")
    rows = size = 0
    for text in question.get("expressions", ()):
        session.check_expression(text)
    for batch in session.run(session.check_query(question["sql"]), question["parameters"]):
        limited = batch if max_rows is None else batch.slice(0, max_rows - rows)
        rows, size = rows + limited.num_rows, size + limited.nbytes
        if max_bytes is not None and size > max_bytes:
            raise BadInput(TOO_LARGE)
        yield from _pieces(limited, _MAX_ROW_BYTES if max_bytes is None else max_bytes)
        if rows == max_rows:
            return


def _pieces(batch: pa.RecordBatch, max_bytes: int) -> Iterator[pa.RecordBatch]:
    """Divide a batch of rows into batches of at most 8 MiB, so that the receiver needs little memory.

    A single row may be larger, but BadInput is raised if it has more than `max_bytes` bytes.
    """
    if batch.nbytes <= _PIECE_BYTES:
        yield batch
    elif batch.num_rows > 1:
        half = batch.num_rows // 2
        yield from _pieces(batch.slice(0, half), max_bytes)
        yield from _pieces(batch.slice(half), max_bytes)
    elif batch.nbytes <= max_bytes:
        yield batch
    else:
        raise BadInput(f"SQL: a row of the result has more than {max_bytes >> 20} MB")


def _error_fields(error: BaseException) -> dict[str, str]:
    kind = "Damaged" if isinstance(error, Damaged) else "BadInput"
    return {"error": TOO_LARGE if isinstance(error, MemoryError) else str(error), "kind": kind}


if __name__ == "__main__":
    command.exit_with_status(main, sys.argv[1:])
