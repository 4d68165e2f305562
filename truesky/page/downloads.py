"""Results as files, piece by piece."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

from aiohttp import web

from lake_schema.errors import BadInput, LakeError
from truesky.explore import results
from truesky.page.opened import Lake, pieces

TYPES = {
    "csv": "text/csv; charset=utf-8",
    "parquet": "application/vnd.apache.parquet",
    "vot": "application/x-votable+xml",
    "fits": "application/fits",
}
_CHUNK = 1 << 20
# s that a reader may take for so many bytes: one who takes nothing must not keep a process for ever.
STALLED, _SIP = 60.0, 1 << 18


async def export(lake: Lake, request: web.Request) -> web.StreamResponse:
    """The result of the query `sql` as a file of `format`."""
    form, text = request.query.get("format", "csv"), request.query.get("sql", "")
    if form not in TYPES:
        raise BadInput(f"format = {form[:40]!r} is not one of {', '.join(TYPES)}")
    async with lake.questions.process() as process:
        batches = process.batches(text, {}, lake.timeout)
        return await sent(request, pieces(results.streamed(batches, f".{form}")), TYPES[form], f"result.{form}")


def chunks(path: Path) -> Iterator[bytes]:
    """A file piece by piece."""
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            yield chunk


async def sent(request: web.Request, stream: AsyncIterator[bytes], kind: str, name: str | None) -> web.StreamResponse:
    """Send a stream; its first piece is made before the status, so that a refusal is one.

    stream : the pieces;  kind : content type;  name : of the file that it is to become, None = shown
    Errors : ConnectionError where the reader is gone, or takes nothing
    """
    first = await anext(stream, b"")
    answer = web.StreamResponse(headers={"Content-Type": kind})
    if name is not None:
        answer.headers["Content-Disposition"] = f'attachment; filename="{name}"'
    await answer.prepare(request)
    try:
        await _taken(request, answer, first)
        async for piece in stream:
            await _taken(request, answer, piece)
    except LakeError:
        # Never a whole answer of half the rows: the connection ends without its last chunk.
        if request.transport is not None:
            request.transport.abort()
        return answer
    await answer.write_eof()
    return answer


async def _taken(request: web.Request, answer: web.StreamResponse, piece: bytes) -> None:
    """Write a piece, as fast as it is read.  Errors: ConnectionError where that is not done for long"""
    view = memoryview(piece)
    for first in range(0, len(view), _SIP):
        try:
            await asyncio.wait_for(answer.write(view[first : first + _SIP]), STALLED)
        except TimeoutError:
            if request.transport is not None:
                request.transport.abort()
            raise ConnectionAbortedError(f"nothing was read for {STALLED:g} s") from None
