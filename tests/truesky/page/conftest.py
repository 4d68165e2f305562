"""A small lake with two images of stars, and a page over it on a free port."""

import asyncio
import contextlib
import http.client
import json
import os
import shutil
import struct
import threading
from dataclasses import dataclass

import numpy as np
import pytest
from aiohttp import web

from lake_schema import ids, sky
from lake_schema.fits import images
from lake_schema.store import layout, parquet, publish
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.exposures import EXPOSURES
from lake_schema.tables.fluxes import fluxes
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.products import PRODUCTS
from lake_schema.tables.rendered_truth import RENDERED_TRUTH
from lake_schema.tables.stars import STARS
from lake_schema.tables.tasks import TASKS
from tests.truesky.page.browsing import at, tab_of
from tests.universe import plain_plan, plain_work, rows_of
from tests.waiting import PATIENCE
from truesky.page.access_control import AccessRules, open_socket
from truesky.page.lake_session import LakeSession
from truesky.page.server import Server
from truesky.render.camera import astrometry

GALAXIES_N, STARS_N = 3000, 250
NX, NY, PIXEL = 700, 600, 0.1 / 3600.0
CENTRE = sky.cell_centre(5, 1607)
TOKEN = "a-token-of-the-tests"


def system():
    """FITS header of both images: north is down, because a detector may be mounted like this."""
    from astropy.wcs import WCS

    made = WCS(naxis=2)
    made.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    made.wcs.cunit = ["deg", "deg"]
    made.wcs.crval = list(CENTRE)
    made.wcs.crpix = [NX / 2, NY / 2]
    made.wcs.cd = np.array([[PIXEL, 0.0], [0.0, -PIXEL]])
    made.wcs.lonpole = 180.0
    made.wcs.radesys = "ICRS"
    made.wcs.set()
    return made


def star_rows():
    """Stars; most of them lie on the images."""
    rng = np.random.default_rng(5)
    rows = rows_of(STARS, STARS_N, seed=5)
    x, y = rng.uniform(0, NX, STARS_N), rng.uniform(0, NY, STARS_N)
    ra, dec = astrometry.sky_of_pixel(system(), x, y)
    index = sky.healpix_29(ra, dec)
    order = np.argsort(index)
    columns = {name: rows[name] for name in STARS.names}
    number = ids.source_id(5, sky.parent(index[order], 29, 8), np.arange(STARS_N))
    columns |= {"ra": ra[order], "dec": dec[order], "_healpix_29": index[order], "id": number}
    return STARS.build(columns), x[order], y[order], number


def image(x, y, electrons, noise):
    """Round stars on a sky of 100 electrons."""
    rng = np.random.default_rng(3)
    row, column = np.mgrid[:NY, :NX]
    out = rng.normal(100.0 if noise else 0.0, 5.0 if noise else 1e-3, (NY, NX))
    for px, py, flux in zip(x, y, electrons, strict=True):
        near = np.s_[max(int(py) - 9, 0) : int(py) + 10, max(int(px) - 9, 0) : int(px) + 10]
        out[near] += flux / 25.1 * np.exp(-((column[near] - px) ** 2 + (row[near] - py) ** 2) / 8.0)
    return out.astype(np.float32)


def images_work(x, y, identifiers):
    electrons = np.geomspace(3e5, 300.0, len(x))
    cards = (*astrometry.cards(system()), ("BUNIT", "electron", "unit"), ("PSFFWHM", 0.47, "[arcsec] PSF FWHM"))
    (ra, dec), here = CENTRE, astrometry.sky_of_pixel(system(), [0, NX - 1, NX - 1, 0], [0, 0, NY - 1, NY - 1])
    region = "POLYGON ICRS " + " ".join(f"{a:.7f} {d:.7f}" for a, d in zip(*here, strict=True))
    contents = ("science", "noise_free", "cosmic_rays")
    paths = {content: f"images/000001/vis_{content}.fits" for content in contents}
    hits = np.zeros((NY, NX), np.float32)
    hits[200:205, 100:140] = 5000.0
    data = {
        "science": image(x, y, electrons, True) + hits,
        "noise_free": image(x, y, electrons, False),
        "cosmic_rays": hits,
    }
    rows = PRODUCTS.build({
        "path": [*paths.values()], "content": contents, "exposure_id": [1] * 3, "detector": ["1-1"] * 3,
        "channel": ["VIS"] * 3, "band": ["euclid_vis"] * 3, "ra": [ra] * 3, "dec": [dec] * 3,
        "s_region": [region] * 3, "mission": ["m"] * 3,
        "sources": [len(x)] * 3,
    })  # fmt: skip
    n = len(x)
    truth = RENDERED_TRUTH.build({
        "exposure_id": [1] * n, "detector": ["1-1"] * n, "id": identifiers, "x": x, "y": y, "expected": electrons,
        "drawn": electrons, "stamp": [19] * n, "method": [0] * n, "trail_x": [None] * n, "trail_y": [None] * n,
    })  # fmt: skip
    files = {
        path: lambda to, content=content: images.write_images(to, [images.Image(data[content], cards)])
        for content, path in paths.items()
    }
    files["truth/000001/1-1.parquet"] = lambda to: parquet.write(to, truth, RENDERED_TRUTH)
    return rows, files, truth


def published(root):
    """Galaxies with fluxes, stars, a plain table, products and their truth."""
    part = Task(layout.cell_file(5, 1607), {})
    galaxies = rows_of(GALAXIES, GALAXIES_N, seed=3)
    shared = {name: galaxies[name] for name in ("id", "ra", "dec", "_healpix_29")}
    declared = fluxes("galaxy", ["euclid_vis"])
    flux = declared.build({**shared, "f_nu_euclid_vis": galaxies["bulge_fraction"], "integrated": [False] * GALAXIES_N})
    stars, x, y, identifiers = star_rows()
    rows, files, truth = images_work(x, y, identifiers)
    for table, found in ((GALAXIES, galaxies), (declared, flux), (STARS, stars)):
        publish.make_version(root, Plan(table, {}, (part,)), lambda lake, facts, found=found: Output(found))
    one = Task("000001-1-1.parquet", {"exposure_id": 1, "detector": "1-1"})
    publish.make_version(root, Plan(PRODUCTS, {}, (one,)), lambda lake, facts: Output(rows, files))
    publish.make_version(root, Plan(RENDERED_TRUTH, {}, (one,)), lambda lake, facts: Output(truth))
    publish.make_version(root, plain_plan(), plain_work)


def square(ra, dec, half):
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    numbers = [f"{ra + x / np.cos(np.radians(dec)):.7f} {dec + y:.7f}" for x, y in corners]
    return "POLYGON ICRS " + " ".join(numbers)


def planned(root):
    """Two exposures: the first has the detector of the images and another one; the second is only planned."""
    published(root)
    (ra, dec), rows = CENTRE, rows_of(EXPOSURES, 2)
    own = {name: rows[name] for name in EXPOSURES.names} | {
        "exposure_id": [1, 2], "channel": ["VIS", "VIS"], "camera": ["vis", "vis"], "band": ["euclid_vis"] * 2,
        "image_type": ["science"] * 2, "ra": [ra, ra + 0.1], "dec": [dec, dec], "position_angle": [0.0, 12.5],
        "mjd": [60905.0, 60906.5], "exposure_time_s": [566.0, 90.0], "grism_angle": [None, None],
    }  # fmt: skip
    exposures = EXPOSURES.build(own)
    rows = rows_of(TASKS, 3)
    places = [(ra, dec), (ra, dec + 0.05), (ra + 0.1, dec)]
    own = {name: rows[name] for name in TASKS.names} | {
        "exposure_id": [1, 1, 2], "detector": ["1-1", "1-2", "3-4"], "channel": ["VIS"] * 3,
        "ra": [place[0] for place in places], "dec": [place[1] for place in places],
        "s_region": [square(*place, 0.009) for place in places],
    }  # fmt: skip
    for table, found in ((EXPOSURES, exposures), (TASKS, TASKS.build(own))):
        part = Task("all.parquet", {})
        publish.make_version(root, Plan(table, {}, (part,)), lambda lake, facts, found=found: Output(found))


@dataclass
class Page:
    """A server that runs in a thread."""

    gate: AccessRules
    server: Server
    loop: asyncio.AbstractEventLoop

    @property
    def origin(self):
        return f"http://127.0.0.1:{self.gate.port}"

    @property
    def tap(self):
        return f"{self.origin}/tap/{self.gate.tap_token}"

    @property
    def cookie(self):
        return f"{self.gate.cookie}={self.gate.token}"

    def ask(self, path, method="GET", body=None, cookie=None, **headers):
        """Status, headers and body, of exactly this request."""
        connection = http.client.HTTPConnection("127.0.0.1", self.gate.port, timeout=PATIENCE)
        connection.putrequest(method, path, skip_host="Host" in headers)
        given = {"Cookie": self.cookie if cookie is None else cookie, **headers}
        if body is not None:
            given["Content-Length"] = str(len(body))
        for name, value in given.items():
            connection.putheader(name.replace("_", "-"), value)
        connection.endheaders(body)
        answer = connection.getresponse()
        with contextlib.closing(connection):
            return answer.status, answer.headers, answer.read()

    def of_lake(self, path, **options):
        """The same of an address of the lake that is open."""
        return self.ask(f"/api/{self.server.lake.key}/{path}", **options)

    def json(self, path, **options):
        status, _, body = self.of_lake(path, **options)
        assert status == 200, body
        return json.loads(body)


@contextlib.contextmanager
def serving(root):
    """Serve a lake within the context."""
    listening = open_socket("127.0.0.1", 0)
    gate = AccessRules(("127.0.0.1", "localhost"), listening.getsockname()[1], TOKEN)
    server = Server(lambda: LakeSession(root, memory=1e9, timeout=PATIENCE), gate)
    loop, ready = asyncio.new_event_loop(), threading.Event()

    async def start():
        runner = web.AppRunner(server.application(), handler_cancellation=True)
        await runner.setup()
        await web.SockSite(runner, listening).start()
        return runner

    def run():
        asyncio.set_event_loop(loop)
        page.runner = loop.run_until_complete(start())
        ready.set()
        loop.run_forever()

    page = Page(gate, server, loop)
    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    assert ready.wait(PATIENCE)
    try:
        yield page
    finally:
        asyncio.run_coroutine_threadsafe(page.runner.cleanup(), loop).result(PATIENCE)
        loop.call_soon_threadsafe(loop.stop)
        thread.join(PATIENCE)


def unpacked(body):
    (length,) = struct.unpack("<I", body[:4])
    return json.loads(body[4 : 4 + length]), body[4 + length :]


def asked(page, **question):
    status, _, body = page.of_lake("charts", method="POST", body=json.dumps(question).encode())
    assert status == 200, body
    head, rest = unpacked(body)
    found, at = [], 0
    for chart in head["charts"]:
        size = int(np.prod(chart["bins"]))
        found.append(np.frombuffer(rest, "<u4", size, at).reshape(chart["bins"]))
        at += 4 * size
    assert at == len(rest)
    return head, found


@pytest.fixture(scope="package")
def shown(tmp_path_factory):
    """The lake that the page shows."""
    root = tmp_path_factory.mktemp("page") / "lake"
    root.mkdir()
    published(root)
    return root


@pytest.fixture(scope="package")
def page(shown):
    with serving(shown) as found:
        yield found


@pytest.fixture(scope="package", name="sky")
def page_of_a_plan(tmp_path_factory):
    """A page over a lake with a plan."""
    root = tmp_path_factory.mktemp("sky") / "lake"
    root.mkdir()
    planned(root)
    with serving(root) as found:
        yield found


@pytest.fixture(scope="module")
def browser():
    """The chromium of the system."""
    from playwright import sync_api as playwright

    chromium = os.environ.get("TRUESKY_CHROMIUM") or shutil.which("chromium")
    if chromium is None:
        pytest.skip("no chromium (Debian: apt install chromium)")
    with playwright.sync_playwright() as started:
        running = started.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield running
        running.close()


@pytest.fixture
def tab(browser, page, request):
    """The page, at the VIEW of the module if it names one."""
    view = getattr(request.module, "VIEW", None)
    address = at(view) if view else "/"
    with tab_of(browser, page, address, permissions=["clipboard-read", "clipboard-write"]) as opened:
        yield opened
