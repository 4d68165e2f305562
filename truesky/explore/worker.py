"""Process that runs queries: python -m truesky.explore.worker LAKE MEMORY TABLE=KEY|@FILE ...; answers go to stdout.

DuckDB does not count the memory of every function nor of its result, and some functions do not stop on request. A
process has a strict limit of memory and can be killed.

A query is a line of JSON on stdin. An answer is a line of JSON. If it is a result, an Arrow stream follows, and a line
of JSON that reports if the stream is complete. Both lines repeat the number of the query, `id`.
"""

from __future__ import annotations

import itertools
import json
import os
import sys
from collections.abc import Iterator, Sequence
from typing import IO, Any

import pyarrow as pa

from lake_schema import command
from lake_schema.errors import BadInput, Damaged, LakeError
from lake_schema.store import layout
from truesky.explore.session import TOO_LARGE, Session

# Memory that Python and the libraries need before any query.
_BASE_BYTES = 1 << 30
# Bytes per piece, and largest size of a row.
_PIECE_BYTES, _MAX_ROW_BYTES = 8 << 20, 64 << 20


def main(argv: Sequence[str]) -> int:
    """Answer queries until stdin ends, and return the exit status.

    `argv` contains the lake, the memory limit in bytes, and entries for the tables: TABLE=KEY or REQUEST.TABLE=KEY,
    =?REQUEST for a table that could not be opened, TABLE=@FILE for rows in an Arrow file.
    """
    root, memory = layout.open_lake(argv[0]), int(argv[1])
    command.limit_resource("RLIMIT_DATA", memory + _BASE_BYTES)
    command.limit_resource("RLIMIT_CORE", 0)
    session = Session(root, dict(entry.split("=", 1) for entry in argv[2:]), memory)
    # Output of libraries must not get between the answers, so it is redirected to stderr.
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    for line in sys.stdin:
        _answer(out, session, json.loads(line))
    return 0


def _answer(out: IO[bytes], session: Session, question: dict[str, Any]) -> None:
    header, fault = {"id": question["id"]}, dict[str, str]()
    batches = _batches(session, question)
    try:
        # Errors in the text are raised before the first of these two batches.
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
    """Batches of the answer, at most `rows` rows; raise BadInput if they have more than `bytes` bytes."""
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
    """Divide a batch into small pieces, so that receivers hold one piece at a time.

    BadInput is raised if a single row has more than `max_bytes` bytes.
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
