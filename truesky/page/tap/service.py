"""A TAP service over the lake: what TOPCAT, Aladin, pyvo and astroquery ask.

Tools send no cookies: a token, another than the page's, stands in its address.

Ref: IVOA Recommendations TAP 1.1, DALI 1.1, VOSI 1.1
"""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import pyarrow as pa
from aiohttp import web

from lake_schema.errors import BadInput, LakeError
from truesky.explore import adql, results, votables
from truesky.page import downloads
from truesky.page.answers import is_catalogue
from truesky.page.gate import Gate
from truesky.page.opened import Busy, Lake, Lane, pieces
from truesky.page.tap import descriptions, waiting
from truesky.page.tap.queries import AT_ONCE, Jobs
from truesky.page.tap.tables import listed, written

MOST_ROWS, USUAL_ROWS = 20_000_000, 1_000_000
_LANGUAGES = ("ADQL", "ADQL-2.0", "ADQL-2.1")
_VOTABLE, _XML = "application/x-votable+xml", "text/xml"
_FORMATS = {
    **{name: (kind, f".{name if name != 'votable' else 'vot'}") for kind, names in descriptions.FORMATS.items()
       for name in names},
    **{kind: (kind, f".{names[-1]}") for kind, names in descriptions.FORMATS.items()},
    "text/xml": ("text/xml", ".vot"), "application/x-votable+xml;serialization=tabledata": (_VOTABLE, ".vot"),
}  # fmt: skip


@dataclass(slots=True)
class _Served:
    """The processes that answer for one opened lake, the folder of the tables that they have beside its own, and those
    of its tables that have positions.
    """

    lake: Lake
    lane: Lane
    folder: tempfile.TemporaryDirectory[str]
    catalogues: set[str]

    def close(self) -> None:
        self.lane.close()
        self.folder.cleanup()


class Service:
    """TAP of whichever lake is open."""

    def __init__(self, gate: Gate) -> None:
        self._gate, self._since = gate, datetime.now(UTC)
        self._served: _Served | None = None
        self._opening = asyncio.Lock()
        self._lake: Callable[[], Lake]
        self.jobs = Jobs(self.answered)

    def add_routes(self, router: web.UrlDispatcher, path: str, lake: Callable[[], Lake]) -> None:
        """Answer below a path.

        lake : the lake that is open
        """
        self._lake = lake
        for method in ("GET", "POST"):
            router.add_route(method, f"{path}/sync", self._told(self._sync))
        router.add_get(f"{path}/availability", self._told(self._availability))
        router.add_get(f"{path}/capabilities", self._told(self._capabilities))
        router.add_get(f"{path}/tables", self._told(self._tables))
        router.add_get(f"{path}/file/{{key}}/{{number}}", self._told(self._image))
        waiting.Routes(self.jobs, self.address, self.check, lambda: self._lake().timeout).add(router, path, self._told)

    async def close(self) -> None:
        """End jobs and processes."""
        await self.jobs.close()
        if self._served is not None:
            self._served.close()

    def address(self, request: web.Request) -> str:
        """Of the service, absolute."""
        return f"http://{request.headers['Host']}/tap/{self._gate.tap_token}"

    # -------------------------------------------------------------------------------------------- questions

    @asynccontextmanager
    async def answered(
        self, parameters: dict[str, str], seconds: float, is_patient: bool = True
    ) -> AsyncIterator[tuple[str, AsyncIterator[bytes]]]:
        """Content type and pieces of the answer to a question.

        parameters : of TAP;  seconds : that it may take;  is_patient : as of `Lane.process`
        Errors     : BadInput, Damaged, Busy
        """
        self.check(parameters)
        kind, ending = _format(parameters)
        most = _most_rows(parameters)
        served = await self._opened()
        text = adql.in_sql(parameters["QUERY"], served.catalogues)
        async with served.lane.process(is_patient) as process:
            batches = process.batches(text, {}, min(seconds, served.lake.timeout), most + 1)
            if ending == ".vot":
                data = votables.pieces(batches, votables.Cut(most))
            else:
                data = results.streamed(_cut(batches, most), ending)
            yield kind, pieces(data)

    def check(self, parameters: dict[str, str]) -> None:
        """Refuse what is no question of ours."""
        if parameters.get("REQUEST", "doQuery") != "doQuery":
            raise BadInput(f"REQUEST = {parameters['REQUEST'][:40]} is not doQuery")
        language = parameters.get("LANG", "")
        if language not in _LANGUAGES:
            raise BadInput(f"LANG = {language[:40]!r} is not one of {', '.join(_LANGUAGES)}")
        if not parameters.get("QUERY", "").strip():
            raise BadInput("QUERY is missing")
        if "UPLOAD" in parameters:
            raise BadInput("UPLOAD: this service takes no tables")
        _format(parameters)
        _most_rows(parameters)

    async def _opened(self) -> _Served:
        lake = self._lake()
        async with self._opening:
            if self._served is None or self._served.lake is not lake:
                if self._served is not None:
                    self._served.close()
                from truesky.page.tap import images

                folder = tempfile.TemporaryDirectory(prefix="truesky-")
                address = f"http://{self._gate.hosts[0]}:{self._gate.port}/tap/{self._gate.tap_token}"
                rows = await asyncio.to_thread(images.obscore, lake, address)
                extra = await asyncio.to_thread(written, lake.listed, rows, Path(folder.name))
                # One more than jobs take: they never hold up who waits for an answer.
                lane = Lane(lambda: lake.explorer.process(extra), AT_ONCE + 1)
                catalogues = {name.lower() for name, version in lake.versions.items() if is_catalogue(version)}
                self._served = _Served(lake, lane, folder, catalogues)
            return self._served

    # -------------------------------------------------------------------------------------------- addresses

    def _told(
        self, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> Callable[[web.Request], Awaitable[web.StreamResponse]]:
        """What is refused is said in a VOTable."""

        async def told(request: web.Request) -> web.StreamResponse:
            try:
                return await handler(request)
            except (LakeError, OSError) as error:
                status = 503 if isinstance(error, Busy) else 400 if isinstance(error, BadInput) else 500
                return web.Response(body=votables.refusal(str(error)), content_type=_VOTABLE, status=status)

        return told

    async def _sync(self, request: web.Request) -> web.StreamResponse:
        parameters = await waiting.parameters(request)
        async with self.answered(parameters, self._lake().timeout, is_patient=False) as (kind, data):
            return await downloads.sent(request, data, kind, None)

    async def _availability(self, request: web.Request) -> web.StreamResponse:
        return web.Response(text=descriptions.availability(self._since), content_type=_XML)

    async def _capabilities(self, request: web.Request) -> web.StreamResponse:
        text = descriptions.capabilities(self.address(request), MOST_ROWS, USUAL_ROWS, self._lake().timeout)
        return web.Response(text=text, content_type=_XML)

    async def _tables(self, request: web.Request) -> web.StreamResponse:
        return web.Response(text=descriptions.tables(listed(self._lake().listed)), content_type=_XML)

    async def _image(self, request: web.Request) -> web.StreamResponse:
        """A FITS file of the products, by its number in the lake of a key."""
        from truesky.page import pictures
        from truesky.page.tap import images

        lake, number = self._lake(), request.match_info["number"]
        if request.match_info["key"] != lake.key or not (number.isascii() and number.isdigit() and len(number) < 10):
            raise web.HTTPNotFound
        if int(number) >= len(await lake.tables.run(pictures.pictures, lake)):
            raise web.HTTPNotFound
        path = await lake.tables.run(images.file, lake, int(number))
        return await downloads.sent(request, pieces(downloads.chunks(path)), "application/fits", path.name)


def _format(parameters: dict[str, str]) -> tuple[str, str]:
    """Content type, and the ending of such a file."""
    wanted = parameters.get("RESPONSEFORMAT") or parameters.get("FORMAT") or "votable"
    if (found := _FORMATS.get(wanted.lower().replace(" ", ""))) is None:
        raise BadInput(f"RESPONSEFORMAT = {wanted[:60]!r} is not one of {', '.join(_FORMATS)}")
    return found


def _most_rows(parameters: dict[str, str]) -> int:
    wanted = parameters.get("MAXREC", str(USUAL_ROWS))
    if not (wanted.isascii() and wanted.isdigit() and len(wanted) < 19):
        raise BadInput(f"MAXREC = {wanted[:40]!r} is not a whole number")
    return min(int(wanted), MOST_ROWS)


def _cut(batches: Iterator[pa.RecordBatch], most: int) -> Iterator[pa.RecordBatch]:
    sent = 0
    for batch in batches:
        yield batch.slice(0, max(most - sent, 0))
        sent += batch.num_rows
