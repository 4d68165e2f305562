"""Which address is answered by what.

What answers is imported when first asked, or when the first sky has been shown: it takes longer to load than that.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import numpy as np
from aiohttp import web

from lake_schema.arrays import Float
from lake_schema.errors import BadInput, LakeError
from truesky.page import answers, downloads, sky_maps
from truesky.page.gate import MOST_BODY, TAP, Gate, dress
from truesky.page.opened import Busy, Closed, Lake
from truesky.page.tap import service

_STATIC = Path(__file__).with_name("static")
_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}
# s that the first sky may take: then the processes are started all the same.
_FIRST_SKY = 3.0
Answer = Callable[[Lake, web.Request], Awaitable[web.StreamResponse]]


class Server:
    """The page over one lake, which can be opened again.

    open_lake : opens it
    """

    def __init__(self, open_lake: Callable[[], Lake], gate: Gate) -> None:
        self._open, self.gate, self.lake = open_lake, gate, open_lake()
        self.tap = service.Service(gate)
        self._opening, self._shown = asyncio.Lock(), asyncio.Event()

    def application(self) -> web.Application:
        """What aiohttp runs."""
        app = web.Application(middlewares=[self.gate.middleware, _refusals], client_max_size=MOST_BODY)
        app.on_response_prepare.append(dress)
        app.on_startup.append(self._warm)
        app.on_cleanup.append(self._close)
        app.router.add_get("/", self._file)
        app.router.add_get("/static/{name}", self._file)
        app.router.add_get("/api/lake", self._described)
        app.router.add_post("/api/reopen", self._reopen)
        for method, path, answer in _ROUTES:
            app.router.add_route(method, f"/api/{{key}}/{path}", self._of_the_lake(answer))
        self.tap.add_routes(app.router, f"{TAP}{{token}}", lambda: self.lake)
        return app

    async def _warm(self, app: web.Application) -> None:
        self._warming = asyncio.create_task(self._warmed())

    async def _warmed(self) -> None:
        """Start the processes when the first sky has been told: beside it they would make it late."""
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._shown.wait(), _FIRST_SKY)
        await asyncio.to_thread(_load)
        await self.lake.warm()

    async def _close(self, app: web.Application) -> None:
        self._warming.cancel()
        await asyncio.gather(self._warming, return_exceptions=True)
        await self.tap.close()
        self.lake.close()

    async def _file(self, request: web.Request) -> web.StreamResponse:
        """A file of the page: those that lie in its folder, no path."""
        name = request.match_info.get("name", "index.html")
        known = {path.name: path for path in _STATIC.iterdir() if path.suffix in _TYPES}
        if name not in known:
            raise web.HTTPNotFound
        return web.Response(text=known[name].read_text(encoding="utf-8"), content_type=_TYPES[known[name].suffix])

    async def _described(self, request: web.Request) -> web.StreamResponse:
        tap_address = f"http://{request.headers['Host']}{TAP}{self.gate.tap_token}"
        lake = self.lake
        is_changed = await lake.tables.run(lake.is_changed)
        return answers.answer({**answers.described(lake), "is_changed": is_changed, "tap": tap_address})

    async def _reopen(self, request: web.Request) -> web.StreamResponse:
        """Show the lake as it is now; whatever was made of it as it was is refused from here on."""
        async with self._opening:
            # Of two who ask at once the second finds it done.
            if await self.lake.tables.run(self.lake.is_changed):
                before, self.lake = self.lake, await self.lake.tables.run(self._open)
                before.close()
        return await self._described(request)

    def _of_the_lake(self, answer: Answer) -> Callable[[web.Request], Awaitable[web.StreamResponse]]:
        async def answered(request: web.Request) -> web.StreamResponse:
            lake = self.lake
            if request.match_info["key"] != lake.key:
                return web.json_response({"error": "the lake has been opened anew", "key": lake.key}, status=409)
            found = await answer(lake, request)
            if answer is _parts:
                self._shown.set()
            return found

        return answered


def _load() -> None:
    """What answers, before it is asked."""
    from truesky.page import charts, pictures, runs, sources  # noqa: F401
    from truesky.page.tap import images  # noqa: F401


@web.middleware
async def _refusals(
    request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
) -> web.StreamResponse:
    """What is refused is said in one line, with a status that tells whose fault it is."""
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


# ------------------------------------------------------------------------------------------------ of one lake


async def _question(request: web.Request) -> dict[str, Any]:
    try:
        found = json.loads(await request.text())
    except (ValueError, RecursionError):
        raise BadInput("the question is no JSON") from None
    if not isinstance(found, dict):
        raise BadInput("the question is no JSON object")
    return found


def _whole(request: web.Request, name: str) -> int:
    text = request.match_info.get(name) or request.query.get(name, "")
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise BadInput(f"{name}: wanted a whole number")
    return int(text)


def _numbers(request: web.Request, *names: str) -> Float:
    try:
        found = np.array([float(request.query[name]) for name in names])
    except (KeyError, ValueError):
        raise BadInput(f"wanted numbers: {', '.join(names)}") from None
    if not np.isfinite(found).all():
        raise BadInput(f"wanted finite numbers: {', '.join(names)}")
    return found


def _view(request: web.Request) -> Float:
    view = _numbers(request, "ra", "dec", "radius")
    if not (-90.0 <= view[1] <= 90.0 and 0.0 < view[2] <= 180.0):
        raise BadInput("dec, radius: outside the sky")
    return view


def _bytes(data: bytes) -> web.Response:
    return web.Response(body=data, content_type="application/octet-stream")


async def _sql(lake: Lake, request: web.Request) -> web.StreamResponse:
    return answers.answer(await answers.sql(lake, await _question(request)))


async def _charts(lake: Lake, request: web.Request) -> web.StreamResponse:
    from truesky.page import charts

    return _bytes(await charts.counts(lake, await _question(request)))


async def _parts(lake: Lake, request: web.Request) -> web.StreamResponse:
    return _bytes(await lake.tables.run(sky_maps.parts, lake, request.match_info["table"]))


async def _density(lake: Lake, request: web.Request) -> web.StreamResponse:
    view = _view(request) if "ra" in request.query else None
    where = request.query.get("where") or "true"
    value = request.query.get("value") or None
    table, order = request.match_info["table"], _whole(request, "order")
    return _bytes(await sky_maps.density(lake, table, order, where, view, value))


async def _coverage(lake: Lake, request: web.Request) -> web.StreamResponse:
    view, band = _view(request) if "ra" in request.query else None, request.query.get("band") or None
    return _bytes(await lake.tables.run(sky_maps.coverage, lake, _whole(request, "order"), view, band))


async def _exposures(lake: Lake, request: web.Request) -> web.StreamResponse:
    view = _view(request) if "ra" in request.query else None
    return answers.answer(await lake.tables.run(sky_maps.exposures, lake, view))


async def _sources(lake: Lake, request: web.Request) -> web.StreamResponse:
    where = request.query.get("where") or "true"
    return answers.answer(await sky_maps.sources(lake, request.match_info["table"], _view(request), where))


async def _tile(lake: Lake, request: web.Request) -> web.StreamResponse:
    from truesky.page import pictures

    number, level, row, column = (_whole(request, name) for name in ("number", "level", "row", "column"))
    mended = request.query.get("mended") == "1"
    found = await lake.pixels.run(lambda: pictures.picture(lake, number).tile(level, row, column, mended))
    return _bytes(found.astype("<f4").tobytes())


async def _cutout(lake: Lake, request: web.Request) -> web.StreamResponse:
    from truesky.page import sources

    x, y = _numbers(request, "x", "y")
    return _bytes(await lake.pixels.run(sources.cutout, lake, _whole(request, "number"), float(x), float(y)))


async def _strip(lake: Lake, request: web.Request) -> web.StreamResponse:
    from truesky.page import sources

    order = _numbers(request, "order")
    number, source = _whole(request, "number"), request.match_info["id"]
    return _bytes(await lake.pixels.run(sources.strip, lake, number, source, int(order[0])))


async def _nearest(lake: Lake, request: web.Request) -> web.StreamResponse:
    from truesky.page import sources

    ra, dec, radius = _view(request)
    return answers.answer(await lake.pixels.run(sources.nearest, lake, float(ra), float(dec), min(radius, 1.0)))


def _told(function: Callable[..., Any], *names: str, is_small: bool = False) -> Answer:
    """An answer of JSON: the function of the lake and of parts of the address, made beside everything else.

    is_small : asked for by the dozen, as tiles are
    """

    async def answered(lake: Lake, request: web.Request) -> web.StreamResponse:
        given = [_whole(request, name) if name == "number" else request.match_info[name] for name in names]
        return answers.answer(await (lake.pixels if is_small else lake.tables).run(function, lake, *given))

    return answered


def _listed(lake: Lake) -> Any:
    from truesky.page import pictures

    return pictures.listed(lake)


def _described(lake: Lake, number: int) -> Any:
    from truesky.page import pictures

    return pictures.described(lake, number)


def _truth(lake: Lake, number: int) -> Any:
    from truesky.page import pictures

    return pictures.truth(lake, number)


def _source(lake: Lake, text: str) -> Any:
    from truesky.page import sources

    return sources.source(lake, text)


def _spectrum(lake: Lake, text: str) -> Any:
    from truesky.page import sources

    return sources.spectrum(lake, text)


def _runs(lake: Lake) -> Any:
    from truesky.page import runs

    return runs.runs(lake)


def _provenance(lake: Lake, number: int) -> Any:
    from truesky.page import runs

    return runs.provenance(lake, number)


_ROUTES: tuple[tuple[str, str, Answer], ...] = (
    ("POST", "sql", _sql),
    ("POST", "charts", _charts),
    ("GET", "export", downloads.export),
    ("GET", "sky/{table}/parts", _parts),
    ("GET", "sky/{table}/density", _density),
    ("GET", "sky/{table}/sources", _sources),
    ("GET", "coverage", _coverage),
    ("GET", "bands", _told(sky_maps.bands)),
    ("GET", "exposures", _exposures),
    ("GET", "regions", _told(sky_maps.regions)),
    ("GET", "images", _told(_listed)),
    ("GET", "image/{number}", _told(_described, "number", is_small=True)),
    ("GET", "tile/{number}/{level}/{row}/{column}", _tile),
    ("GET", "truth/{number}", _told(_truth, "number", is_small=True)),
    ("GET", "cutout/{number}", _cutout),
    ("GET", "trace/{number}/{id}", _strip),
    ("GET", "nearest", _nearest),
    ("GET", "source/{id}", _told(_source, "id", is_small=True)),
    ("GET", "spectrum/{id}", _told(_spectrum, "id")),
    ("GET", "runs", _told(_runs)),
    ("GET", "provenance/{number}", _told(_provenance, "number")),
)
