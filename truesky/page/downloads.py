"""Results as files, piece by piece."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

from aiohttp import web

from lake_schema.errors import BadInput, LakeError
from truesky.explore import results
from truesky.page.lake_session import LakeSession, iterate_in_thread

CONTENT_TYPES = {
    "csv": "text/csv; charset=utf-8",
    "parquet": "application/vnd.apache.parquet",
    "vot": "application/x-votable+xml",
    "fits": "application/fits",
}
_CHUNK_SIZE = 1 << 20
# s that a reader may take for so many bytes: one who takes nothing must not keep a process for ever.
STALL_TIMEOUT, _WRITE_SIZE = 60.0, 1 << 18


async def export(lake: LakeSession, request: web.Request) -> web.StreamResponse:
    """The result of the query `sql` as a file of `format`."""
    form, text = request.query.get("format", "csv"), request.query.get("sql", "")
    if form not in CONTENT_TYPES:
        raise BadInput(f"format = {form[:40]!r} is not one of {', '.join(CONTENT_TYPES)}")
    async with lake.user_queries.process() as process:
        batches = process.batches(text, {}, lake.timeout)
        return await send_stream(
            request, iterate_in_thread(results.stream_file(batches, f".{form}")), CONTENT_TYPES[form], f"result.{form}"
        )


def read_chunks(path: Path) -> Iterator[bytes]:
    """A file piece by piece."""
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_SIZE):
            yield chunk


async def send_stream(
    request: web.Request, stream: AsyncIterator[bytes], content_type: str, file_name: str | None
) -> web.StreamResponse:
    """Send a stream; its first piece is made before the status, so that a refusal is one.

    stream : the pieces;  kind : content type;  name : of the file that it is to become, None = shown
    Errors : ConnectionError where the reader is gone, or takes nothing
    """
    first = await anext(stream, b"")
    response = web.StreamResponse(headers={"Content-Type": content_type})
    if file_name is not None:
        response.headers["Content-Disposition"] = f'attachment; filename="{file_name}"'
    await response.prepare(request)
    try:
        await _write_piece(request, response, first)
        async for piece in stream:
            await _write_piece(request, response, piece)
    except LakeError:
        # Never a whole answer of half the rows: the connection ends without its last chunk.
        if request.transport is not None:
            request.transport.abort()
        return response
    await response.write_eof()
    return response


async def _write_piece(request: web.Request, response: web.StreamResponse, piece: bytes) -> None:
    """Write a piece, as fast as it is read.  Errors: ConnectionError where that is not done for long"""
    view = memoryview(piece)
    for first in range(0, len(view), _WRITE_SIZE):
        try:
            await asyncio.wait_for(response.write(view[first : first + _WRITE_SIZE]), STALL_TIMEOUT)
        except TimeoutError:
            if request.transport is not None:
                request.transport.abort()
            raise ConnectionAbortedError(f"nothing was read for {STALL_TIMEOUT:g} s") from None
