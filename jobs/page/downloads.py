"""Results as files: CSV, Parquet and VOTable piece by piece, FITS through a temporary file."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
from aiohttp import web

from jobs.explore import results
from jobs.explore.process import Process
from jobs.page.opened import Lake, pieces
from lake_schema.errors import BadInput, LakeError

TYPES = {
    "csv": "text/csv; charset=utf-8",
    "parquet": "application/vnd.apache.parquet",
    "vot": "application/x-votable+xml",
    "fits": "application/fits",
}
# FITS wants the number of rows first, and all of them in memory.
MOST_FITS_ROWS, MOST_FITS_BYTES = 2_000_000, 128 << 20
_CHUNK = 1 << 20


async def export(lake: Lake, request: web.Request) -> web.StreamResponse:
    """The result of the query `sql` as a file of `format`."""
    form, text = request.query.get("format", "csv"), request.query.get("sql", "")
    if form not in TYPES:
        raise BadInput(f"format = {form[:40]!r} is not one of {', '.join(TYPES)}")
    async with lake.questions.process() as process:
        if form == "fits":
            with tempfile.TemporaryDirectory(prefix="truesky-") as folder:
                path = await asyncio.to_thread(_fits, lake, process, text, Path(folder))
                return await sent(request, pieces(chunks(path)), TYPES[form], "result.fits")
        batches = process.batches(text, {}, lake.timeout)
        return await sent(request, pieces(results.streamed(batches, f".{form}")), TYPES[form], f"result.{form}")


def _fits(lake: Lake, process: Process, text: str, folder: Path) -> Path:
    found, size = [], 0
    for batch in process.batches(text, {}, lake.timeout, MOST_FITS_ROWS + 1):
        found.append(batch)
        size += batch.nbytes
        _refuse(size > MOST_FITS_BYTES, f"{MOST_FITS_BYTES >> 20} MB")
    rows = pa.Table.from_batches(found)
    _refuse(rows.num_rows > MOST_FITS_ROWS, f"{MOST_FITS_ROWS:,} rows")
    # There every text of a column takes as many bytes as the longest.
    longest = [pc.max(pc.binary_length(column)).as_py() for column in rows.columns if pa.types.is_string(column.type)]
    _refuse(rows.num_rows * sum(length or 0 for length in longest) > MOST_FITS_BYTES, f"{MOST_FITS_BYTES >> 20} MB")
    results.write(rows, folder / "result.fits")
    return folder / "result.fits"


def _refuse(is_too_much: bool, bound: str) -> None:
    if is_too_much:
        raise BadInput(f"more than {bound}: ask for CSV, Parquet or a VOTable, which come in pieces")


def chunks(path: Path) -> Iterator[bytes]:
    """A file piece by piece."""
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            yield chunk


async def sent(request: web.Request, stream: AsyncIterator[bytes], kind: str, name: str | None) -> web.StreamResponse:
    """Send a stream; its first piece is made before the status, so that a refusal is one.

    stream : the pieces;  kind : content type;  name : of the file that it is to become, None = shown
    """
    first = await anext(stream, b"")
    answer = web.StreamResponse(headers={"Content-Type": kind})
    if name is not None:
        answer.headers["Content-Disposition"] = f'attachment; filename="{name}"'
    await answer.prepare(request)
    await answer.write(first)
    try:
        async for piece in stream:
            await answer.write(piece)
    except LakeError:
        # Never a whole answer of half the rows: the connection ends without its last chunk.
        if request.transport is not None:
            request.transport.abort()
        return answer
    await answer.write_eof()
    return answer
