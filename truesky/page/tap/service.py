"""HTTP handlers of the TAP service of a lake, for tools such as TOPCAT, Aladin, pyvo and astroquery.

These tools send no cookies, so the address of the service contains a secret token. The web page has another token.

References
----------
IVOA Recommendations TAP 1.1, DALI 1.1, VOSI 1.1
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
from truesky.page.access_control import AccessRules
from truesky.page.answers import is_catalogue
from truesky.page.lake_session import Busy, LakeSession, ProcessPool, iterate_in_thread
from truesky.page.tap import descriptions, uws_jobs
from truesky.page.tap.queries import PARALLEL_JOBS, Jobs
from truesky.page.tap.tables import list_tables, write_tables

# Largest number of rows of an answer.
MAX_ROWS = 20_000_000
# Largest number of rows if a query has no parameter MAXREC.
DEFAULT_ROWS = 1_000_000
_LANGUAGES = ("ADQL", "ADQL-2.0", "ADQL-2.1")
_VOTABLE, _XML = "application/x-votable+xml", "text/xml"
_FORMATS = {
    **{name: (kind, f".{name if name != 'votable' else 'vot'}") for kind, names in descriptions.FORMATS.items()
       for name in names},
    **{kind: (kind, f".{names[-1]}") for kind, names in descriptions.FORMATS.items()},
    "text/xml": ("text/xml", ".vot"), "application/x-votable+xml;serialization=tabledata": (_VOTABLE, ".vot"),
}  # fmt: skip


@dataclass(slots=True)
class _LakeProcesses:
    """Query processes of one open lake.

    `folder` contains the tables that TAP adds to the lake, as Arrow files. `catalogues` contains the names of the
    tables with positions on the sky, in lower case.
    """

    lake: LakeSession
    process_pool: ProcessPool
    folder: tempfile.TemporaryDirectory[str]
    catalogues: set[str]

    def close(self) -> None:
        self.process_pool.close()
        self.folder.cleanup()


class Service:
    """TAP service of the lake that the server currently shows.

    Parameters
    ----------
    access : AccessRules
        Host names, port and tokens of the server.
    """

    def __init__(self, access: AccessRules) -> None:
        self._access, self._up_since = access, datetime.now(UTC)
        self._lake_processes: _LakeProcesses | None = None
        self._opening = asyncio.Lock()
        self._current_lake: Callable[[], LakeSession]
        self.jobs = Jobs(self.run_query)

    def add_routes(self, router: web.UrlDispatcher, path: str, lake: Callable[[], LakeSession]) -> None:
        """Add the addresses of the service and their handlers to an application.

        Parameters
        ----------
        router : aiohttp.web.UrlDispatcher
            Router of the application.
        path : str
            Path of the service; all its addresses begin with it.
        lake : callable
            Function without arguments that returns the `LakeSession` that the server currently shows.
        """
        self._current_lake = lake
        for method in ("GET", "POST"):
            router.add_route(method, f"{path}/sync", self._errors_to_votable(self._sync))
        router.add_get(f"{path}/availability", self._errors_to_votable(self._availability))
        router.add_get(f"{path}/capabilities", self._errors_to_votable(self._capabilities))
        router.add_get(f"{path}/tables", self._errors_to_votable(self._tables))
        router.add_get(f"{path}/file/{{key}}/{{number}}", self._errors_to_votable(self._image))
        uws_jobs.Routes(self.jobs, self.service_address, lambda: self._current_lake().timeout).add(
            router, path, self._errors_to_votable
        )

    async def close(self) -> None:
        """Stop all asynchronous jobs and query processes."""
        await self.jobs.close()
        if self._lake_processes is not None:
            self._lake_processes.close()

    def service_address(self, request: web.Request) -> str:
        """Return the absolute URL of the service, with the host name that the client used in `request`."""
        return f"http://{request.headers['Host']}/tap/{self._access.tap_token}"

    @asynccontextmanager
    async def run_query(
        self, parameters: dict[str, str], seconds: float, is_patient: bool = True
    ) -> AsyncIterator[tuple[str, AsyncIterator[bytes]]]:
        """Run an ADQL query and provide its result during an `async with` block.

        Parameters
        ----------
        parameters : dict of str to str
            Parameters of TAP by upper-case name, such as QUERY, LANG and MAXREC.
        seconds : float
            Time limit of the query in seconds; the time limit of the lake applies, too.
        is_patient : bool, optional
            If True, wait for a query process even if many queries are waiting.

        Yields
        ------
        content_type : str
            HTTP content type of the result.
        pieces : asynchronous iterator of bytes
            Content of the result. It raises BadInput if the query fails, and Damaged if a file is damaged.

        Notes
        -----
        BadInput is raised if a parameter is invalid or the query cannot be translated to SQL. Busy is raised if too
        many queries are waiting and `is_patient` is False.
        """
        self.check_parameters(parameters)
        content_type, suffix = _output_format(parameters)
        max_rows = _max_rows(parameters)
        lake_processes = await self._open_processes()
        text = adql.to_sql(parameters["QUERY"], lake_processes.catalogues)
        async with lake_processes.process_pool.process(is_patient) as process:
            batches = process.batches(text, {}, min(seconds, lake_processes.lake.timeout), max_rows + 1)
            if suffix == ".vot":
                data = votables.pieces(batches, votables.RowLimit(max_rows))
            else:
                data = results.stream_file(_limit_rows(batches, max_rows), suffix)
            yield content_type, iterate_in_thread(data, lake_processes.process_pool.threads)

    def check_parameters(self, parameters: dict[str, str]) -> None:
        """Raise BadInput if the parameters of TAP do not describe a query that this service can run.

        REQUEST must be doQuery if given, LANG must be ADQL, ADQL-2.0 or ADQL-2.1, QUERY must not be empty, UPLOAD must
        not be given, and the format and MAXREC must be valid. The text of the query is not checked here.
        """
        if parameters.get("REQUEST", "doQuery") != "doQuery":
            raise BadInput(f"REQUEST = {parameters['REQUEST'][:40]} is not doQuery")
        language = parameters.get("LANG", "")
        if language not in _LANGUAGES:
            raise BadInput(f"LANG = {language[:40]!r} is not one of {', '.join(_LANGUAGES)}")
        if not parameters.get("QUERY", "").strip():
            raise BadInput("QUERY is missing")
        if "UPLOAD" in parameters:
            raise BadInput("UPLOAD is not supported by this service")
        _output_format(parameters)
        _max_rows(parameters)

    async def _open_processes(self) -> _LakeProcesses:
        lake = self._current_lake()
        async with self._opening:
            if self._lake_processes is None or self._lake_processes.lake is not lake:
                if self._lake_processes is not None:
                    self._lake_processes.close()
                from truesky.page.tap import images

                folder = tempfile.TemporaryDirectory(prefix="truesky-")
                address = f"http://{self._access.hosts[0]}:{self._access.port}/tap/{self._access.tap_token}"
                rows = await asyncio.to_thread(images.obscore_rows, lake, address)
                table_files = await asyncio.to_thread(write_tables, lake.listed_versions, rows, Path(folder.name))
                # There is one process more than the jobs that can run at the same time, so that one is always free for
                # synchronous queries.
                process_pool = ProcessPool(lambda: lake.explorer.process(table_files), PARALLEL_JOBS + 1)
                catalogues = {name.lower() for name, version in lake.versions.items() if is_catalogue(version)}
                self._lake_processes = _LakeProcesses(lake, process_pool, folder, catalogues)
            return self._lake_processes

    def _errors_to_votable(
        self, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> Callable[[web.Request], Awaitable[web.StreamResponse]]:
        """Wrap an HTTP handler, so that its errors become VOTables with the message.

        The HTTP status is 503 if too many queries are waiting, 400 for wrong input, and 500 for other LakeErrors and
        for OSError. Further errors are raised unchanged.
        """

        async def respond(request: web.Request) -> web.StreamResponse:
            try:
                return await handler(request)
            except (LakeError, OSError) as error:
                status = 503 if isinstance(error, Busy) else 400 if isinstance(error, BadInput) else 500
                return web.Response(body=votables.refusal(str(error)), content_type=_VOTABLE, status=status)

        return respond

    async def _sync(self, request: web.Request) -> web.StreamResponse:
        parameters = await uws_jobs.read_parameters(request)
        async with self.run_query(parameters, self._current_lake().timeout, is_patient=False) as (content_type, data):
            return await downloads.send_stream(request, data, content_type, None)

    async def _availability(self, request: web.Request) -> web.StreamResponse:
        return web.Response(text=descriptions.availability(self._up_since), content_type=_XML)

    async def _capabilities(self, request: web.Request) -> web.StreamResponse:
        text = descriptions.capabilities(
            self.service_address(request), MAX_ROWS, DEFAULT_ROWS, self._current_lake().timeout
        )
        return web.Response(text=text, content_type=_XML)

    async def _tables(self, request: web.Request) -> web.StreamResponse:
        return web.Response(
            text=descriptions.describe_tables(list_tables(self._current_lake().listed_versions)), content_type=_XML
        )

    async def _image(self, request: web.Request) -> web.StreamResponse:
        """Send the FITS file of the image with the number in the address.

        The status is 404 if there is no such image, or if the lake has changed since the address was given out: then
        the key in the address differs from the key of the lake.
        """
        from truesky.page import pictures
        from truesky.page.tap import images

        lake, number = self._current_lake(), request.match_info["number"]
        if request.match_info["key"] != lake.key or not (number.isascii() and number.isdigit() and len(number) < 10):
            raise web.HTTPNotFound
        if int(number) >= len(await lake.table_pool.run(pictures.pictures, lake)):
            raise web.HTTPNotFound
        path = await lake.table_pool.run(images.find_file, lake, int(number))
        return await downloads.send_stream(
            request, iterate_in_thread(downloads.read_chunks(path)), "application/fits", path.name
        )


def _output_format(parameters: dict[str, str]) -> tuple[str, str]:
    """Return the HTTP content type and the file suffix of the format that a query requests; VOTable by default.

    BadInput is raised for an unknown format.
    """
    format_name = parameters.get("RESPONSEFORMAT") or parameters.get("FORMAT") or "votable"
    if (output_format := _FORMATS.get(format_name.lower().replace(" ", ""))) is None:
        raise BadInput(f"RESPONSEFORMAT = {format_name[:60]!r} is not one of {', '.join(_FORMATS)}")
    return output_format


def _max_rows(parameters: dict[str, str]) -> int:
    limit_text = parameters.get("MAXREC", str(DEFAULT_ROWS))
    if not (limit_text.isascii() and limit_text.isdigit() and len(limit_text) < 19):
        raise BadInput(f"MAXREC = {limit_text[:40]!r} is not a whole number")
    return min(int(limit_text), MAX_ROWS)


def _limit_rows(batches: Iterator[pa.RecordBatch], max_rows: int) -> Iterator[pa.RecordBatch]:
    num_sent = 0
    for batch in batches:
        yield batch.slice(0, max(max_rows - num_sent, 0))
        num_sent += batch.num_rows
