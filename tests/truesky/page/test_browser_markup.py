"""A stranger's lake, whose names, texts and files contain HTML: no script runs, and the text is shown as it is.

Names of tables and requests are folders of the lake, and a reader takes no folder whose name has other characters than
a-z, 0-9, _ and -. All other texts of a lake may contain anything.
"""

import json
import re
import time
from dataclasses import replace
from urllib.parse import quote, urlencode
from xml.etree import ElementTree

import numpy as np
import pytest

from lake_schema.columns import Column, Table
from lake_schema.store import layout, publish
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.exposures import EXPOSURES
from lake_schema.tables.fluxes import fluxes
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.mission import MISSION
from lake_schema.tables.passbands import PASSBANDS
from lake_schema.tables.products import PRODUCTS
from lake_schema.tables.rendered_truth import RENDERED_TRUTH
from lake_schema.tables.stars import STARS
from lake_schema.tables.tasks import TASKS
from tests.truesky.page import conftest
from tests.truesky.page.browsing import DRAWN, HELD, VIEWS, at, copied, tab_of, until, write_query
from tests.universe import rows_of
from tests.waiting import until as reach

# Texts that would run a script as markup, in an attribute, in a script and as an address.
IMAGE = "<img src=x onerror=window.hit=1>"
SVG = '"><svg onload="window.hit=1">'
SCRIPT = "</script><script>window.hit=1</script>"
ADDRESS = "javascript:window.hit=1"
FRAME = "'><iframe srcdoc='<script>parent.hit=1</script>'>"
ALL = (IMAGE, SVG, SCRIPT, ADDRESS, FRAME)
# The end of a file's name, which has no slash. In a header of HTTP it would begin another one.
FILE = f'{IMAGE}"\r\nX-Hit: 1.fits'
BAND = f"b{IMAGE}"
# Every element that a text of the lake could have become. The page has scripts, but only with an address.
STRANGERS = """() => [document, document.getElementById('sql-editor').shadowRoot].filter((root) => root)
  .flatMap((root) => [...root.querySelectorAll('img:not(.cm-widgetBuffer), svg, iframe, object, embed, base'
    + ', a:not(.skip), [onload], [onerror], script:not([src])')]).map((one) => one.outerHTML)"""


def ingested():
    """Return the declaration of a table whose columns a stranger has named, and its rows."""
    columns = [Column("id", "int64", doc=SCRIPT)]
    for k, text in enumerate(ALL):
        columns.append(Column(f"n{text}", "float64", SVG, IMAGE, FRAME))
        columns.append(Column(f"{k}{text}", "string", doc=text))
    table = Table("ingested", 1, tuple(columns), f"Meaning {SVG}{SCRIPT}", key=("id",))
    values = {column.name: np.linspace(1.0, 9.0, 20) for column in columns if column.type == "float64"}
    texts = {column.name: [ALL[i % 5] for i in range(20)] for column in columns if column.type == "string"}
    return table, table.build({"id": np.arange(20), **values, **texts})


def without_codes(table):
    """Return the declaration without the lists of allowed values, which a stranger's writer need not check."""
    return replace(table, columns=tuple(replace(column, codes=()) for column in table.columns))


def of_rows(table, count, **own):
    rows = rows_of(table, count)
    return table.build({name: rows[name] for name in table.names} | own)


def images(stars):
    """Return the rows and files of images, a detector, a band and a content of which are markup."""
    _, x, y, identifiers = stars
    rows, files, truth = conftest.images_work(x, y, identifiers)
    count, paths = rows.num_rows, {path: path.replace("vis_", f"vis_{IMAGE}").replace(".fits", FILE)
                                   for path in rows["path"].to_pylist()}  # fmt: skip
    own = {"path": [*paths.values()], "detector": [IMAGE] * count, "band": [BAND] * count, "mission": [SVG] * count}
    own["content"] = ["science", "noise_free", SVG]
    named = {paths.get(path, f"truth/000001/{IMAGE}.parquet"): write for path, write in files.items()}
    columns = {name: truth[name] for name in RENDERED_TRUTH.names} | {"detector": [IMAGE] * truth.num_rows}
    products = PRODUCTS.build({name: rows[name] for name in PRODUCTS.names} | own)
    return products, named, RENDERED_TRUTH.build(columns)


def published(root):
    """Write a lake with markup in every text that a lake may contain."""
    stars, (ra, dec) = conftest.star_rows(), conftest.CENTRE
    galaxies, declared = rows_of(GALAXIES, 500, seed=3), fluxes("galaxy", [BAND])
    shared = {name: galaxies[name] for name in ("id", "ra", "dec", "_healpix_29")}
    light = {**shared, f"f_nu_{BAND}": galaxies["bulge_fraction"], "integrated": [False] * 500}
    products, files, truth = images(stars)
    place = {"exposure_id": [1], "channel": ["VIS"], "ra": [ra], "dec": [dec]}
    exposures = of_rows(EXPOSURES, 1, **place, camera=[SVG], band=[BAND], image_type=["science"], position_angle=[0.0])
    tasks = of_rows(TASKS, 1, **place, detector=[IMAGE], s_region=[conftest.square(ra, dec, 0.009)])
    changed = {"overridden": [True], "chosen": [True]}
    mission = of_rows(MISSION, 1, name=[SCRIPT], unit=[SVG], source=[FRAME], **changed)
    passbands = of_rows(PASSBANDS, 1, name=[BAND], source=[SVG], sha256=[IMAGE])
    cell, one = Task(layout.cell_file(5, 1607), {}), Task("000001-1-1.parquet", {"exposure_id": 1, "detector": IMAGE})
    own, rows = ingested()
    for table, part, output in (
        (GALAXIES, cell, Output(galaxies)), (declared, cell, Output(declared.build(light))),
        (STARS, cell, Output(stars[0])), (PRODUCTS, one, Output(products, files)), (RENDERED_TRUTH, one, Output(truth)),
        (EXPOSURES, one, Output(exposures)), (TASKS, one, Output(tasks)), (MISSION, one, Output(mission)),
        (PASSBANDS, one, Output(passbands)), (own, one, Output(rows)),
    ):  # fmt: skip
        plan = Plan(without_codes(table), {"of": SCRIPT}, (part,))
        publish.make_version(root, plan, lambda lake, facts, output=output: output)
    broken = publish.make_version(root, Plan(replace(own, name="broken"), {}, (one,)), lambda *_: Output(rows))
    (broken / "manifest.json").write_text(json.dumps({"digest": SVG}))
    log = layout.runs_folder(root) / "20260101-products-1.jsonl"
    log.parent.mkdir(exist_ok=True)
    lines = [
        {"job": SCRIPT, "table": "products"},
        {"part": f"{SVG}.parquet", "error": IMAGE, "attempt": 1, "seconds": 1.0, "peak_gb": 1.0},
        {"status": "failed", "seconds": 2.0},
    ]
    log.write_text("".join(f"{json.dumps(line)}\n" for line in lines))


@pytest.fixture(scope="module")
def stranger(tmp_path_factory):
    """Serve the lake, whose folder has markup in its name."""
    root = tmp_path_factory.mktemp("markup") / 'lake "><svg onload="window.hit=1"><img src=x onerror=window.hit=1>'
    root.mkdir()
    published(root)
    with conftest.serving(root) as page:
        yield page


@pytest.fixture
def tab(browser, stranger):
    with tab_of(browser, stranger, at("sql"), permissions=["clipboard-read", "clipboard-write"]) as opened:
        yield opened
        assert opened.evaluate("window.hit === undefined")
        assert opened.evaluate(STRANGERS) == []


def shown(tab, view):
    tab.click(f"#tab-{view}")
    until(tab, f"!document.getElementById('{view}').hidden")


@pytest.mark.nightly
def test_the_lake_the_sky_and_the_runs(tab, stranger):
    assert tab.text_content("#lake-name") == str(stranger.server.lake.root)
    shown(tab, "sky")
    until(tab, DRAWN["sky"])
    bands = (
        "[...document.getElementById('sky-table').querySelectorAll('optgroup option')].map((one) => one.textContent)"
    )
    until(tab, f"{bands}.length > 1")
    assert f"depth in {BAND}" in tab.evaluate(bands)
    for table in (f"coverage of {BAND}", "stars"):
        legend = f"document.getElementById('sky-legend').textContent.includes({json.dumps(table.split(' of ')[-1])})"
        # On a busy machine, a query may end at its time limit; then a user selects the table again.
        for _ in range(5):
            tab.select_option("#sky-table", "galaxies")
            tab.select_option("#sky-table", table)
            ended = time.monotonic() + 60.0
            while not tab.evaluate(legend) and time.monotonic() < ended:
                time.sleep(0.05)
            if tab.evaluate(legend):
                break
        until(tab, legend)
    tab.select_option("#sky-footprints", "exposures")
    tab.select_option("#sky-footprints", "products")
    until(tab, "document.getElementById('sky-states').textContent.includes('observed')")
    tab.fill("#sky-value", f"length('{SVG}')")
    tab.press("#sky-value", "Enter")
    until(tab, f"document.getElementById('sky-legend').textContent.includes({json.dumps(SVG)})")
    shown(tab, "runs")
    until(tab, DRAWN["runs"])
    said = tab.text_content("#runs-content")
    for text in (SCRIPT, f"{SVG}.parquet", IMAGE, FILE, "broken"):
        assert text in said
    for summary in tab.locator("#runs-content summary").all():
        summary.click()
    until(tab, "document.querySelectorAll('#runs-content details ul').length >= 3")


@pytest.mark.nightly
def test_images_and_their_sources(tab):
    shown(tab, "images")
    until(tab, f"{HELD}.images?.zoom > 0 && {DRAWN['images']}")
    names = tab.locator("#image-one option").all_text_contents()
    assert names == [f"1 VIS {BAND} {IMAGE}: {what}" for what in ("science", "noise free", SVG.replace("_", " "))]
    tab.select_option("#image-two", "1")
    tab.check("#image-truth")
    until(tab, "document.getElementById('image-legend').textContent.includes('sources')")
    request = copied(tab, "#image-request")
    assert f"band = {json.dumps(BAND)}" in request
    assert f"camera = {json.dumps(SVG)}" in request
    assert f"detectors = [{json.dumps(IMAGE)}]" in request
    tab.locator("#image-canvas").click()
    for of in ("stars", "galaxies"):
        sql = f"{{ sql: 'SELECT id::VARCHAR FROM {of} LIMIT 1' }}"
        first = f"import('/static/api.js').then((api) => api.post('sql', {sql})).then((found) => found.rows[0][0])"
        number = tab.evaluate(first)
        tab.evaluate(f"import('/static/pin.js').then(({{ pin }}) => pin('{number}'))")
        until(tab, f"document.getElementById('pin').textContent.includes('{number}')")
    # The last source is a galaxy, whose flux has the name of its band.
    assert f"f_nu_{BAND}" in tab.text_content("#pin")
    star = "import('/static/api.js').then((api) => api.get('truth/0')).then((found) => found.id[0])"
    tab.evaluate(f"{star}.then((id) => import('/static/pin.js').then(({{ pin }}) => pin(id)))")
    until(tab, "document.querySelector('#pin .cutouts')?.childElementCount > 1")
    assert f"{BAND} noise free" in tab.text_content("#pin .cutouts")
    assert IMAGE in tab.text_content("#pin")


def test_columns_and_results_of_queries(tab):
    until(tab, DRAWN["sql"])
    schema = tab.text_content("#sql-schema")
    for text in (*(f"n{text}" for text in ALL), f"f_nu_{BAND}", f"Meaning {SVG}{SCRIPT}"):
        assert text in schema
    tab.locator("#sql-schema summary", has_text="ingested").click()
    write_query(tab, "SELECT * FROM ingested")
    tab.press("#sql-text", "Control+Enter")
    until(tab, f"document.getElementById('sql-result').textContent.includes({json.dumps('n' + FRAME)})")
    cells = tab.locator("#sql-result td").all_text_contents()
    assert set(ALL) <= set(cells)
    aliases = ", ".join(
        f"'{text.replace(chr(39), chr(39) * 2)}' AS \"{text.replace(chr(34), chr(34) * 2)}\"" for text in ALL
    )
    write_query(tab, f"SELECT {aliases}")
    tab.press("#sql-text", "Control+Enter")
    until(tab, "document.getElementById('sql-state').textContent.startsWith('1 rows')")
    assert tab.locator("#sql-result th").all_text_contents() == list(ALL)
    assert tab.locator("#sql-result td").all_text_contents() == list(ALL)
    # The editor completes the names, and shows the meaning of the selected one.
    write_query(tab, "SELECT 1 FROM ingested WHERE ")
    tab.press("#sql-text", "Control+End")
    tab.keyboard.type("n")
    tab.keyboard.press("Control+Space")
    options = "[...document.getElementById('sql-editor').shadowRoot.querySelectorAll('.cm-completionLabel')]"
    until(tab, f"{options}.some((one) => one.textContent === {json.dumps('n' + IMAGE)})")
    tab.keyboard.press("Escape")


@pytest.mark.parametrize("kind", ["csv", "parquet", "vot", "fits"])
def test_downloads_contain_the_text(stranger, kind):
    status, headers, body = stranger.of_lake(
        "export?" + urlencode({"format": kind, "sql": f"SELECT '{IMAGE}' AS \"{IMAGE}\""})
    )
    assert (status, headers["Content-Disposition"]) == (200, f'attachment; filename="result.{kind}"')
    assert "html" not in headers["Content-Type"]
    assert (IMAGE.replace("<", "&lt;").replace(">", "&gt;") if kind == "vot" else IMAGE).encode() in body


@pytest.mark.nightly
def test_charts_of_columns_with_markup(tab):
    shown(tab, "plots")
    until(tab, DRAWN["plots"])
    tab.fill("#plot-source", "ingested")
    tab.press("#plot-source", "Tab")
    ranges = "[...document.querySelectorAll('#plot-grid .range')].map((one) => one.textContent)"
    until(tab, f"{ranges}.length === 5 && {ranges}.every((text) => text.startsWith('20 rows'))")
    names = tab.locator("#plot-grid figcaption strong").all_text_contents()
    assert names == [*(f"n{text}" for text in ALL[:4]), f"n{SVG} against n{IMAGE}"]
    for button in tab.locator("#plot-grid button", has_text="Table").all():
        button.click()
    until(tab, "document.querySelectorAll('#plot-grid table').length === 5")
    assert f"n{SVG} / {SVG}" in tab.locator("#plot-grid table").last.text_content()
    # The result of a query with these names is plotted as well.
    shown(tab, "sql")
    until(tab, DRAWN["sql"])
    write_query(tab, "SELECT * FROM ingested")
    tab.click("#sql-run")
    until(tab, "document.getElementById('sql-state').textContent.startsWith('20 rows')")
    tab.click("#sql-plot")
    until(tab, f"!document.getElementById('plots').hidden && {ranges}.length === 3")
    until(tab, f"{ranges}.every((text) => text.startsWith('20 rows'))")


@pytest.mark.nightly
def test_errors_with_markup(browser, stranger):
    with tab_of(browser, stranger, at("sql"), refused="/api/") as tab:
        until(tab, DRAWN["sql"])
        write_query(tab, f'SELECT "{IMAGE}" FROM galaxies')
        tab.click("#sql-run")
        until(tab, f"document.getElementById('sql-state').textContent.includes({json.dumps(IMAGE)})")
        shown(tab, "plots")
        tab.fill("#plot-where", f"'{IMAGE}'::INTEGER > 0")
        tab.press("#plot-where", "Tab")
        until(tab, f"document.getElementById('plot-state').textContent.includes({json.dumps(IMAGE)})")
        shown(tab, "sky")
        tab.fill("#sky-where", f"'{IMAGE}'::INTEGER > 0")
        tab.press("#sky-where", "Enter")
        until(tab, f"document.getElementById('said').textContent.includes({json.dumps(IMAGE)})")
        assert tab.evaluate("window.hit === undefined")
        assert tab.evaluate(STRANGERS) == []


def test_an_address_with_markup(browser, stranger):
    """The state in an address comes from whoever sends the link."""
    held = {"view": SVG, "lake": IMAGE, "theme": SVG, "sql": {"text": SCRIPT},
            "sky": {"table": f"coverage of {IMAGE}", "where": f"'{SVG}' > ''", "value": IMAGE, "map": SVG},
            "plots": {"source": f"galaxies -- {IMAGE}", "where": "true",
                      "charts": [{"axes": [{"expression": f"'{SVG}'", "log": False}], "spans": None, "brush": None}]},
            "images": {"map": SVG, "stretch": IMAGE, "black": SVG, "pin": ADDRESS}}  # fmt: skip
    address = "/#" + re.sub(r"\+", "%20", urlencode({"": json.dumps(held)})[1:])
    with tab_of(browser, stranger, address, refused="/api/") as tab:
        for view in VIEWS:
            shown(tab, view)
            tab.wait_for_timeout(300)
        assert tab.evaluate("window.hit === undefined")
        assert tab.evaluate(STRANGERS) == []


@pytest.mark.nightly
def test_documents_of_the_tap_service(browser, stranger):
    """A browser that opens an address of the service runs nothing, and XML readers find the text."""
    from playwright import sync_api as playwright

    query = f"SELECT '{IMAGE}' AS \"{SVG[2:6]}{IMAGE}\", x FROM {SCRIPT}"
    form = urlencode({"LANG": "ADQL", "QUERY": query, "RUNID": SVG, "PHASE": "RUN", IMAGE: FRAME}).encode()
    kind, tap = "application/x-www-form-urlencoded", stranger.tap.removeprefix(stranger.origin)
    status, headers, _ = stranger.ask(f"{tap}/async", "POST", form, "", Content_Type=kind)
    job = headers["Location"].removeprefix(stranger.origin)
    assert status == 303
    reach(lambda: stranger.ask(f"{job}/phase", cookie="")[2] == b"ERROR")
    good = urlencode({"LANG": "ADQL", "QUERY": "SELECT * FROM ingested"})
    obscore = urlencode({"LANG": "ADQL", "QUERY": "SELECT * FROM ivoa.obscore"})
    paths = {f"{tap}/tables": f"n{IMAGE}", f"{tap}/sync?{good}": SCRIPT, f"{tap}/sync?{obscore}": IMAGE,
             job: SVG, f"{job}/parameters": SCRIPT, f"{job}/error": "", f"{tap}/async": "",
             f"{tap}/sync?{urlencode({'LANG': SVG, 'QUERY': SCRIPT})}": ""}  # fmt: skip
    opened = browser.new_context()
    for path, text in paths.items():
        tab, heard = opened.new_page(), []
        tab.on("dialog", lambda dialog, heard=heard: heard.append(dialog.message))
        tab.on("request", lambda request, heard=heard: heard.append(request.url))
        status, headers, body = stranger.ask(path, cookie="")
        assert status in (200, 400), path
        found = ElementTree.fromstring(body)
        assert text in "".join((*found.itertext(), *(value for one in found.iter() for value in one.attrib.values())))
        try:
            tab.goto(stranger.origin + path, wait_until="load")
        except playwright.Error as error:
            # The browser saves a VOTable, and shows no document.
            if not re.search("Download is starting|ERR_ABORTED", str(error)):
                raise
        until(tab, "window.hit === undefined")
        tab.wait_for_timeout(100)
        until(tab, "window.hit === undefined")
        assert heard in ([stranger.origin + path], [stranger.origin + path, f"{stranger.origin}/favicon.ico"])
        tab.close()
    opened.close()


def test_a_file_of_an_image_keeps_its_name(stranger):
    tap = stranger.tap.removeprefix(stranger.origin)
    status, headers, _ = stranger.ask(f"{tap}/file/{stranger.server.lake.key}/0", cookie="")
    assert (status, headers["Content-Type"]) == (200, "application/fits")
    assert headers["X-Hit"] is None
    assert headers["Content-Disposition"] == "attachment; filename*=UTF-8''" + quote(
        f"vis_{IMAGE}science{FILE}", safe=""
    )
    assert headers.get_filename() == f"vis_{IMAGE}science{FILE}"


def test_folders_with_markup_are_no_tables_and_no_requests(stranger):
    """A reader takes no name that has other characters than a-z, 0-9, _ and -."""
    root = stranger.server.lake.root
    for folder in (root / IMAGE, root / "names" / IMAGE):
        folder.mkdir(parents=True)
    (root / IMAGE / "current").symlink_to("v-0123456789abcdef")
    (root / "names" / IMAGE / "stars").symlink_to("../../stars/v-0123456789abcdef")
    assert IMAGE not in json.dumps([one["name"] for one in json.loads(stranger.ask("/api/lake")[2])["tables"]])
    status, _, body = stranger.of_lake(
        "sql", method="POST", body=json.dumps({"sql": f'SELECT * FROM "{IMAGE}"'}).encode()
    )
    assert status == 400
    assert "is not a table of the lake" in json.loads(body)["error"]
