"""HTTP server of the web page of a lake (the folder with all tables and images): maps addresses to handlers.

The modules that the handlers use take long to import. They are imported on first use, or after the first sky map has
been sent.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import numpy as np
from aiohttp import web

from lake_schema.arrays import Float
from lake_schema.errors import BadInput, LakeError
from truesky.page import answers, downloads, sky_maps
from truesky.page.access_control import (
    CONNECTION_SETTINGS,
    MAX_BODY_BYTES,
    TAP_PATH,
    AccessRules,
    add_security_headers,
    is_no_client_error,
    limit_body,
)
from truesky.page.lake_session import Busy, Closed, LakeSession
from truesky.page.tap import service

_STATIC = Path(__file__).with_name("static")
_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}
# The query processes start after the first sky map has been sent, but at the latest this time (s) after the server.
_FIRST_SKY_TIMEOUT = 3.0
LakeHandler = Callable[[LakeSession, web.Request], Awaitable[web.StreamResponse]]


class Server:
    """Server of the web page and of the TAP service for one lake, which can be opened again while the server runs.

    Parameters
    ----------
    open_lake : callable
        Function without arguments that opens the lake and returns a new `LakeSession`.
    access : AccessRules
        Host names and tokens that HTTP requests must have.
    """

    def __init__(self, open_lake: Callable[[], LakeSession], access: AccessRules) -> None:
        self._open_lake, self.access, self.lake = open_lake, access, open_lake()
        self.tap = service.Service(access)
        self._opening, self._first_sky_shown = asyncio.Lock(), asyncio.Event()

    def application(self) -> web.Application:
        """Return the aiohttp application with all addresses of the page and of the TAP service."""
        logging.getLogger("aiohttp.server").addFilter(is_no_client_error)
        app = web.Application(
            middlewares=[self.access.middleware, _errors_to_json],
            client_max_size=MAX_BODY_BYTES,
            handler_args=CONNECTION_SETTINGS,
        )
        app.on_response_prepare.append(add_security_headers)
        app.on_startup.append(self._start_warm_up)
        app.on_cleanup.append(self._close)
        app.router.add_get("/", self._file)
        app.router.add_get("/static/{name}", self._file)
        app.router.add_get("/api/lake", self._describe_lake)
        app.router.add_post("/api/reopen", self._reopen_lake)
        for method, path, handler in _ROUTES:
            app.router.add_route(method, f"/api/{{key}}/{path}", self._check_key(handler))
        self.tap.add_routes(app.router, f"{TAP_PATH}{{token}}", lambda: self.lake)
        return app

    async def _start_warm_up(self, app: web.Application) -> None:
        self._warm_up_task = asyncio.create_task(self._warm_up())

    async def _warm_up(self) -> None:
        """Import the modules of the handlers and start the query processes.

        This begins after the first sky map has been sent, or after 3 s, because it would delay that map.
        """
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._first_sky_shown.wait(), _FIRST_SKY_TIMEOUT)
        await asyncio.to_thread(_import_handlers)
        await self.lake.warm()

    async def _close(self, app: web.Application) -> None:
        self._warm_up_task.cancel()
        await asyncio.gather(self._warm_up_task, return_exceptions=True)
        await self.tap.close()
        self.lake.close()

    async def _file(self, request: web.Request) -> web.StreamResponse:
        """Send an HTML, CSS, JavaScript or SVG file of the page.

        Only files directly in the folder static/ can be sent. Other names, also those with a path, get status 404.
        """
        name = request.match_info.get("name", "index.html")
        files = {path.name: path for path in _STATIC.iterdir() if path.suffix in _TYPES}
        if name not in files:
            raise web.HTTPNotFound
        return web.Response(text=files[name].read_text(encoding="utf-8"), content_type=_TYPES[files[name].suffix])

    async def _describe_lake(self, request: web.Request) -> web.StreamResponse:
        tap_address = f"http://{request.headers['Host']}{TAP_PATH}{self.access.tap_token}"
        lake = self.lake
        is_changed = await lake.table_pool.run(lake.is_changed)
        return answers.json_response({**answers.describe_lake(lake), "is_changed": is_changed, "tap": tap_address})

    async def _reopen_lake(self, request: web.Request) -> web.StreamResponse:
        """Open the lake again if one of its tables has changed, and send its description.

        After a change, HTTP requests with the key of the previous state get the status 409, so that the page loads all
        data again.
        """
        async with self._opening:
            # The lock makes sure that the lake is opened only once if two clients ask for it at the same time: the
            # second request then finds an unchanged lake.
            if await self.lake.table_pool.run(self.lake.is_changed):
                previous, self.lake = self.lake, await self.lake.table_pool.run(self._open_lake)
                previous.close()
        return await self._describe_lake(request)

    def _check_key(self, handler: LakeHandler) -> Callable[[web.Request], Awaitable[web.StreamResponse]]:
        async def respond(request: web.Request) -> web.StreamResponse:
            lake = self.lake
            if request.match_info["key"] != lake.key:
                return web.json_response({"error": "the lake has been opened again", "key": lake.key}, status=409)
            response = await handler(lake, request)
            if handler is _partition_density:
                self._first_sky_shown.set()
            return response

        return respond


def _import_handlers() -> None:
    """Import the modules of the handlers, so that their first HTTP request need not wait for it."""
    from truesky.page import charts, pictures, runs, sources  # noqa: F401
    from truesky.page.tap import images  # noqa: F401


@web.middleware
async def _errors_to_json(
    request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
) -> web.StreamResponse:
    """Call a handler and turn its errors into JSON responses with an HTTP status.

    The status is 409 if the lake was opened again, 429 if too many requests are waiting, 400 for wrong input, and 500
    if the lake is damaged, a disc fails or the memory is exhausted.
    """
    try:
        return await handler(request)
    except Closed as error:
        return web.json_response({"error": str(error)}, status=409)
    except Busy as error:
        return web.json_response({"error": str(error)}, status=429)
    except BadInput as error:
        return web.json_response({"error": str(error)}, status=400)
    except (LakeError, OSError, MemoryError) as error:
        return web.json_response({"error": str(error) or type(error).__name__}, status=500)


async def _read_json(request: web.Request) -> dict[str, Any]:
    async with limit_body():
        await request.read()
    try:
        # The body is in memory now.
        content = json.loads(await request.text())
        # JSON may contain lone surrogates as escape sequences, but they cannot be encoded again.
        json.dumps(content, ensure_ascii=False).encode()
    except (ValueError, LookupError, RecursionError):
        raise BadInput("the body of the request is not JSON, or its characters cannot be encoded") from None
    if not isinstance(content, dict):
        raise BadInput("the body of the request is not a JSON object")
    return content


def _integer_parameter(request: web.Request, name: str, is_signed: bool = False) -> int:
    """Return a whole number from the path or the query of an address; only if `is_signed` is True may it be negative.

    BadInput is raised if the parameter is missing or anything else.
    """
    text = request.match_info.get(name) or request.query.get(name, "")
    digits = text.removeprefix("-") if is_signed else text
    if not (digits.isascii() and digits.isdigit() and len(digits) < 10):
        raise BadInput(f"{name} must be a whole number with at most 9 digits")
    return int(text)


def _float_parameters(request: web.Request, *names: str) -> Float:
    try:
        numbers = np.array([float(request.query[name]) for name in names])
    except (KeyError, ValueError):
        raise BadInput(f"{', '.join(names)} must be numbers") from None
    if not np.isfinite(numbers).all():
        raise BadInput(f"{', '.join(names)} must be finite numbers")
    return numbers


def _view_parameter(request: web.Request) -> Float:
    view = _float_parameters(request, "ra", "dec", "radius")
    if not (-90.0 <= view[1] <= 90.0 and 0.0 < view[2] <= 180.0):
        raise BadInput("dec must be in [-90, 90] and radius in (0, 180]")
    return view


def _binary_response(data: bytes) -> web.Response:
    return web.Response(body=data, content_type="application/octet-stream")


async def _sql(lake: LakeSession, request: web.Request) -> web.StreamResponse:
    return answers.json_response(await answers.run_query(lake, await _read_json(request)))


async def _charts(lake: LakeSession, request: web.Request) -> web.StreamResponse:
    from truesky.page import charts

    return _binary_response(await charts.count_rows(lake, await _read_json(request)))


async def _partition_density(lake: LakeSession, request: web.Request) -> web.StreamResponse:
    return _binary_response(await lake.table_pool.run(sky_maps.partition_density, lake, request.match_info["table"]))


async def _density(lake: LakeSession, request: web.Request) -> web.StreamResponse:
    view = _view_parameter(request) if "ra" in request.query else None
    where = request.query.get("where") or "true"
    value = request.query.get("value") or None
    table, order = request.match_info["table"], _integer_parameter(request, "order")
    return _binary_response(await sky_maps.density(lake, table, order, where, view, value))


async def _coverage(lake: LakeSession, request: web.Request) -> web.StreamResponse:
    view, band = _view_parameter(request) if "ra" in request.query else None, request.query.get("band") or None
    return _binary_response(
        await lake.table_pool.run(sky_maps.coverage, lake, _integer_parameter(request, "order"), view, band)
    )


async def _exposures(lake: LakeSession, request: web.Request) -> web.StreamResponse:
    view = _view_parameter(request) if "ra" in request.query else None
    return answers.json_response(await lake.table_pool.run(sky_maps.exposure_footprints, lake, view))


async def _sources(lake: LakeSession, request: web.Request) -> web.StreamResponse:
    where = request.query.get("where") or "true"
    return answers.json_response(
        await sky_maps.sources_in_view(lake, request.match_info["table"], _view_parameter(request), where)
    )


async def _tile(lake: LakeSession, request: web.Request) -> web.StreamResponse:
    from truesky.page import pictures

    number, level, row, column = (_integer_parameter(request, name) for name in ("number", "level", "row", "column"))
    without_cosmic_rays = request.query.get("mended") == "1"
    tile = await lake.pixel_pool.run(
        lambda: pictures.picture(lake, number).tile(level, row, column, without_cosmic_rays)
    )
    return _binary_response(tile.astype("<f4").tobytes())


async def _cutout(lake: LakeSession, request: web.Request) -> web.StreamResponse:
    from truesky.page import sources

    x, y = _float_parameters(request, "x", "y")
    return _binary_response(
        await lake.pixel_pool.run(sources.cutout, lake, _integer_parameter(request, "number"), float(x), float(y))
    )


async def _trace_strip(lake: LakeSession, request: web.Request) -> web.StreamResponse:
    from truesky.page import sources

    number, order = _integer_parameter(request, "number"), _integer_parameter(request, "order", is_signed=True)
    source = request.match_info["id"]
    return _binary_response(await lake.pixel_pool.run(sources.trace_strip, lake, number, source, order))


async def _trace_at(lake: LakeSession, request: web.Request) -> web.StreamResponse:
    from truesky.page import sources

    x, y = _float_parameters(request, "x", "y")
    number = _integer_parameter(request, "number")
    return answers.json_response(await lake.pixel_pool.run(sources.trace_at, lake, number, float(x), float(y)))


async def _nearest(lake: LakeSession, request: web.Request) -> web.StreamResponse:
    from truesky.page import sources

    ra, dec, radius = _view_parameter(request)
    return answers.json_response(
        await lake.pixel_pool.run(sources.nearest_source, lake, float(ra), float(dec), min(radius, 1.0))
    )


def _json_handler(function: Callable[..., Any], *names: str, is_small: bool = False) -> LakeHandler:
    """Return an HTTP handler that runs a function in a thread and sends its result as JSON.

    Parameters
    ----------
    function : callable
        Function whose first argument is the open lake, followed by one argument for each of `names`.
    *names : str
        Names of variable parts of the HTTP path, such as "id" in source/{id}. They are passed to the function as text,
        and "number" as an integer.
    is_small : bool, optional
        If True, use the threads for short, frequent HTTP requests.

    Returns
    -------
    LakeHandler
        The handler.
    """

    async def respond(lake: LakeSession, request: web.Request) -> web.StreamResponse:
        arguments = [
            _integer_parameter(request, name) if name == "number" else request.match_info[name] for name in names
        ]
        return answers.json_response(
            await (lake.pixel_pool if is_small else lake.table_pool).run(function, lake, *arguments)
        )

    return respond


def _list_images(lake: LakeSession) -> Any:
    from truesky.page import pictures

    return pictures.list_images(lake)


def _describe_image(lake: LakeSession, number: int) -> Any:
    from truesky.page import pictures

    return pictures.describe_image(lake, number)


def _truth(lake: LakeSession, number: int) -> Any:
    from truesky.page import pictures

    return pictures.bright_sources(lake, number)


def _source(lake: LakeSession, text: str) -> Any:
    from truesky.page import sources

    return sources.describe_source(lake, text)


def _spectrum(lake: LakeSession, text: str) -> Any:
    from truesky.page import sources

    return sources.spectrum(lake, text)


def _runs(lake: LakeSession) -> Any:
    from truesky.page import runs

    return runs.runs(lake)


def _provenance(lake: LakeSession, number: int) -> Any:
    from truesky.page import runs

    return runs.provenance(lake, number)


_ROUTES: tuple[tuple[str, str, LakeHandler], ...] = (
    ("POST", "sql", _sql),
    ("POST", "charts", _charts),
    ("GET", "export", downloads.export),
    ("GET", "sky/{table}/parts", _partition_density),
    ("GET", "sky/{table}/density", _density),
    ("GET", "sky/{table}/sources", _sources),
    ("GET", "coverage", _coverage),
    ("GET", "bands", _json_handler(sky_maps.bands)),
    ("GET", "exposures", _exposures),
    ("GET", "regions", _json_handler(sky_maps.regions)),
    ("GET", "images", _json_handler(_list_images)),
    ("GET", "image/{number}", _json_handler(_describe_image, "number", is_small=True)),
    ("GET", "tile/{number}/{level}/{row}/{column}", _tile),
    ("GET", "truth/{number}", _json_handler(_truth, "number", is_small=True)),
    ("GET", "cutout/{number}", _cutout),
    ("GET", "trace/{number}/{id}", _trace_strip),
    ("GET", "trace_at/{number}", _trace_at),
    ("GET", "nearest", _nearest),
    ("GET", "source/{id}", _json_handler(_source, "id", is_small=True)),
    ("GET", "spectrum/{id}", _json_handler(_spectrum, "id")),
    ("GET", "runs", _json_handler(_runs)),
    ("GET", "provenance/{number}", _json_handler(_provenance, "number")),
)
