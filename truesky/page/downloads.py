"""Send files and query results to HTTP clients in chunks, while they are read or computed."""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from urllib.parse import quote

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
# Longest time in seconds that a client may take to read 256 KiB (_WRITE_SIZE). Slower clients are disconnected, so that
# the query process becomes free.
STALL_TIMEOUT = 60.0
# Number of bytes that are sent to a client at a time.
_WRITE_SIZE = 1 << 18


async def export(lake: LakeSession, request: web.Request) -> web.StreamResponse:
    """Send the result of an SQL query as a file.

    The query is the HTTP parameter `sql`. The parameter `format` is csv (default), parquet, vot or fits. BadInput is
    raised for another format, and if the query fails before its first rows.
    """
    form, text = request.query.get("format", "csv"), request.query.get("sql", "")
    if form not in CONTENT_TYPES:
        raise BadInput(f"format = {form[:40]!r} is not one of {', '.join(CONTENT_TYPES)}")
    async with lake.user_queries.process() as process:
        batches = process.batches(text, {}, lake.timeout)
        data = iterate_in_thread(results.stream_file(batches, f".{form}"), lake.user_queries.threads)
        return await send_stream(request, data, CONTENT_TYPES[form], f"result.{form}")


def read_chunks(path: Path) -> Iterator[bytes]:
    """Yield the content of a file in chunks of 1 MiB."""
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_SIZE):
            yield chunk


async def send_stream(
    request: web.Request, stream: AsyncIterator[bytes], content_type: str, file_name: str | None
) -> web.StreamResponse:
    """Send a stream of bytes to an HTTP client.

    The first chunk is computed before the HTTP status is sent, so that an error in it gives an error status.

    Parameters
    ----------
    request : aiohttp.web.Request
        The HTTP request to answer.
    stream : asynchronous iterator of bytes
        Content of the response in chunks.
    content_type : str
        HTTP content type of the response.
    file_name : str or None
        Name under which the browser saves the response; None to show it in the browser.

    Returns
    -------
    aiohttp.web.StreamResponse
        The response. It was sent completely, or the connection was aborted, because a LakeError was raised after the
        first chunk.

    Raises
    ------
    ConnectionError
        If the client has closed the connection, or has not read for 60 s.
    LakeError
        If the first chunk cannot be computed.
    """
    first = await anext(stream, b"")
    response = web.StreamResponse(headers={"Content-Type": content_type})
    if file_name is not None:
        response.headers["Content-Disposition"] = f"attachment; {_name_parameter(file_name)}"
    await response.prepare(request)
    try:
        await _write_piece(request, response, first)
        async for piece in stream:
            await _write_piece(request, response, piece)
    except LakeError:
        # Abort the connection without the chunk that marks the end of the response. The client then reports an error,
        # and does not take a part of the rows for the whole result.
        if request.transport is not None:
            request.transport.abort()
        return response
    await response.write_eof()
    return response


def _name_parameter(file_name: str) -> str:
    """Return the parameter of the HTTP header Content-Disposition for the name of a file.

    The name of an image in a lake may contain any character. A quote would end the name, and a new line the header, so
    such names are percent-encoded (RFC 6266).
    """
    if re.fullmatch(r"[A-Za-z0-9_.+-]+", file_name):
        return f'filename="{file_name}"'
    return f"filename*=UTF-8''{quote(file_name, safe='')}"


async def _write_piece(request: web.Request, response: web.StreamResponse, piece: bytes) -> None:
    """Send bytes as fast as the client reads them.

    ConnectionError is raised if the client takes more than 60 s for 256 KiB.
    """
    view = memoryview(piece)
    for first in range(0, len(view), _WRITE_SIZE):
        try:
            await asyncio.wait_for(response.write(view[first : first + _WRITE_SIZE]), STALL_TIMEOUT)
        except TimeoutError:
            if request.transport is not None:
                request.transport.abort()
            raise ConnectionAbortedError(f"the client read nothing for {STALL_TIMEOUT:g} s") from None
