"""The page in a browser: every view, brushes, keys, images, the address; no error, and no request to another host."""

import os
import shutil
import time
from contextlib import contextmanager, suppress

import numpy as np
import pytest

from jobs.page import charts
from lake_schema.store import publish, read
from tests.jobs.page import test_traces
from tests.jobs.page.conftest import GALAXIES_N, published, serving
from tests.universe import plain_plan, plain_work

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed (extra browser)")
CHROMIUM = os.environ.get("TRUESKY_CHROMIUM") or shutil.which("chromium")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium (Debian: apt install chromium)")
VIEWS = ("sky", "plots", "sql", "images", "runs")


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as started:
        running = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield running
        running.close()


def until(tab, expression, seconds=30.0):
    """Wait without eval, which the page's policy refuses."""
    end = time.monotonic() + seconds
    while True:
        # A page that is being loaded says nothing.
        with suppress(playwright.Error):
            if value := tab.evaluate(expression):
                return value
        assert time.monotonic() < end, expression
        time.sleep(0.03)


@contextmanager
def tab_of(browser, page, address="/", **context):
    """The page in a tab that has its cookie; at its end nothing may have gone wrong."""
    faults = []
    opened = browser.new_context(viewport={"width": 1280, "height": 800}, **context)
    tab = opened.new_page()
    tab.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
    tab.on("pageerror", lambda error: faults.append(str(error)))

    def lost(request):
        # What is under way when an address is left is given up.
        if request.failure != "net::ERR_ABORTED":
            faults.append(f"{request.url} {request.failure}")

    tab.on("requestfailed", lost)
    tab.on("response", lambda answer: faults.append(f"{answer.url} {answer.status}") if answer.status >= 400 else None)
    own = (page.origin + "/", "data:", "blob:")
    tab.on("request", lambda request: None if request.url.startswith(own) else faults.append(request.url))
    tab.goto(f"{page.origin}/?token={page.gate.token}")
    if address != "/":
        tab.goto(page.origin + address)
        tab.reload()
    until(tab, "document.body.dataset.ready === '1'")
    yield tab
    opened.close()
    assert faults == []


@pytest.fixture
def tab(browser, page):
    with tab_of(browser, page) as opened:
        yield opened


def canvas_colours(tab, selector):
    """How many colours a picture of an element has."""
    import io

    from matplotlib.image import imread

    pixels = imread(io.BytesIO(tab.locator(selector).first.screenshot()), format="png")[..., :3]
    return len(np.unique(pixels.reshape(-1, 3), axis=0))


def test_every_view_is_drawn(tab):
    for number, view in enumerate(VIEWS, start=1):
        tab.keyboard.press(str(number))
        until(tab, f"!document.getElementById('{view}').hidden")
        assert tab.get_attribute(f"#tab-{view}", "aria-selected") == "true"
        if view == "sky":
            until(tab, "document.getElementById('sky-legend').textContent.includes('deg')")
            assert canvas_colours(tab, "#sky .stage") > 30
        if view == "plots":
            until(tab, "document.getElementById('plot-state').textContent.includes('rows')")
            assert canvas_colours(tab, "#plot-grid figure.map canvas") > 20
        if view == "sql":
            until(tab, "document.querySelectorAll('#sql-result td').length > 0")
        if view == "images":
            until(tab, "document.getElementById('image-one').childElementCount === 3")
            time.sleep(1.0)
            assert canvas_colours(tab, "#image-canvas") > 30
        if view == "runs":
            until(tab, "document.querySelectorAll('#runs-content h2').length > 2")


def drag(tab, selector, first, last):
    """Drag over a canvas, from and to parts of its width."""
    box = tab.locator(selector).first.bounding_box()
    y = box["y"] + 0.4 * box["height"]
    tab.mouse.move(box["x"] + first * box["width"], y)
    tab.mouse.down()
    for part in np.linspace(first, last, 12):
        tab.mouse.move(box["x"] + part * box["width"], y)
    return tab.mouse


def test_brushes_filter_the_other_charts(tab, shown):
    tab.keyboard.press("2")
    ranges = "[...document.querySelectorAll('#plot-grid .range')].map((one) => one.textContent)"
    until(tab, f"{ranges}.every((text) => text.includes('rows'))")
    whole = tab.evaluate(ranges)
    drag(tab, "#plot-grid canvas", 0.3, 0.6).up()
    until(tab, f"{ranges}[1] !== {whole[1]!r}")
    time.sleep(0.5)
    brush = tab.evaluate("JSON.parse(decodeURIComponent(location.hash.slice(1))).plots.charts[0].brush[0]")
    z, mag = (read.version(shown, "galaxies").rows([name])[name].to_numpy() for name in ("z_obs", "mag_r01"))
    spans = tab.evaluate("JSON.parse(decodeURIComponent(location.hash.slice(1))).plots.charts[1].spans[0]")
    inside = (z >= brush[0]) & (z <= brush[1]) & (mag >= spans[0]) & (mag <= spans[1])
    assert 0 < inside.sum() < GALAXIES_N
    assert tab.evaluate(ranges)[1].replace("\N{NARROW NO-BREAK SPACE}", "").startswith(f"{inside.sum()} rows")
    # The map of the same column against another is cut, too.
    assert tab.evaluate(ranges)[4] != whole[4]
    tab.locator("#plot-grid canvas").first.focus()
    tab.keyboard.press("Escape")
    until(tab, f"{ranges}[1] === {whole[1]!r}")
    for _ in range(3):
        tab.keyboard.press("Shift+ArrowRight")
    until(tab, f"{ranges}[1] !== {whole[1]!r}")


def test_a_held_brush_asks_nothing(tab):
    tab.keyboard.press("2")
    until(tab, "document.getElementById('plot-state').textContent.includes('rows')")
    asked, answered = [], []
    tab.on("request", lambda request: asked.append(request.url))
    tab.on("requestfinished", lambda request: answered.append(request.url))
    mouse = drag(tab, "#plot-grid canvas", 0.3, 0.35)
    # What was asked when it was taken hold of.
    rest = time.monotonic() + 1.0
    while time.monotonic() < rest:
        tab.wait_for_timeout(50)
        if len(answered) < len(asked):
            rest = time.monotonic() + 1.0
    asked.clear()
    ranges = "[...document.querySelectorAll('#plot-grid .range')].map((one) => one.textContent)[1]"
    before, box = tab.evaluate(ranges), tab.locator("#plot-grid canvas").first.bounding_box()
    for part in np.linspace(0.35, 0.8, 20):
        mouse.move(box["x"] + part * box["width"], box["y"] + 50)
    assert tab.evaluate(ranges) != before
    assert asked == []
    mouse.up()


def test_of_many_rows_every_brush_counts_a_sample_first(browser, page, monkeypatch):
    monkeypatch.setattr(charts, "ROWS_A_CORE", 10)
    with tab_of(browser, page) as tab:
        tab.keyboard.press("2")
        asked = []
        tab.on("request", lambda one: asked.append(one.post_data_json["part"]) if "charts" in one.url else None)
        state = "document.getElementById('plot-state').textContent"
        until(tab, f"{state}.includes('rows') && !{state}.includes('sample')")
        for _ in range(2):
            asked.clear()
            tab.locator("#plot-grid canvas").first.focus()
            tab.keyboard.press("Shift+ArrowRight")
            until(tab, f"{state}.includes('sample')")
            until(tab, f"!{state}.includes('sample')")
            assert (asked[0], asked[-1]) == (None, 1)


def test_a_map_as_points(tab, shown):
    tab.keyboard.press("2")
    ranges = "[...document.querySelectorAll('#plot-grid figure.map .range')].map((one) => one.textContent)"
    until(tab, f"{ranges}[0].includes('a bin')")
    before = tab.locator("#plot-grid figure.map canvas").first.screenshot()
    tab.locator("#plot-grid figure.map button", has_text="points").first.click()
    text = until(tab, f"{ranges}[0].includes('points') && {ranges}[0]").replace("\N{NARROW NO-BREAK SPACE}", "")
    rows, points = (int(text.split(f" {word}")[0].split()[-1]) for word in ("rows", "points"))
    assert 0 < points == rows <= GALAXIES_N
    assert tab.locator("#plot-grid figure.map canvas").first.screenshot() != before
    until(tab, "JSON.parse(decodeURIComponent(location.hash.slice(1))).plots.charts[4].points === true")


def test_charts_are_tables_too(tab):
    """The same numbers: of the sky, of a histogram, of a map, of a spectrum's bands."""
    tab.keyboard.press("1")
    until(tab, "document.getElementById('sky-legend').textContent.includes('deg')")
    tab.click("#sky-to-table")
    assert tab.locator("#sky-data tbody tr").count() > 0
    assert "deg" in tab.inner_text("#sky-data thead")
    tab.keyboard.press("2")
    until(tab, "[...document.querySelectorAll('#plot-grid .range')].every((one) => one.textContent.includes('rows'))")
    for place in (0, 4):
        figure = tab.locator("#plot-grid figure").nth(place)
        figure.locator("button", has_text="Table").click()
        numbers = [int(text.replace("\N{NARROW NO-BREAK SPACE}", "")) for text in
                   figure.locator("tbody td:last-child").all_inner_texts()]  # fmt: skip
        total = figure.locator(".range").inner_text().replace("\N{NARROW NO-BREAK SPACE}", "").split(" rows")[0]
        # Of a map the fullest bins.
        assert sum(numbers) == int(total) if place == 0 else 0 < sum(numbers) <= int(total)


def test_a_source_through_the_grism(browser, tmp_path):
    root = tmp_path / "lake"
    root.mkdir()
    own, wavelength = test_traces.published(root)
    with serving(root) as page, tab_of(browser, page) as tab:
        tab.keyboard.press("4")
        until(tab, "document.getElementById('image-one').childElementCount === 1")
        time.sleep(1.0)
        without = canvas_colours(tab, "#image-marks")
        box, truth = tab.locator("#image-canvas").bounding_box(), page.json("truth/0")
        zoom = 0.98 * min(box["width"] / 700, box["height"] / 600)
        tab.mouse.click(box["x"] + box["width"] / 2 - (truth["x"][0] - 349.5) * zoom,
                        box["y"] + box["height"] / 2 + (truth["y"][0] - 299.5) * zoom)  # fmt: skip
        until(tab, f"document.getElementById('pin').textContent.includes('{own}')")
        until(
            tab, "document.querySelector('#pin canvas.strip')?.getAttribute('aria-label')?.includes('1206 to 1892 nm')"
        )
        assert canvas_colours(tab, "#pin canvas.strip") > 2
        time.sleep(0.3)
        assert canvas_colours(tab, "#image-marks") > without
        tab.locator("#pin summary", has_text="orders as a table").click()
        words = tab.locator("#pin details[open]").inner_text()
        assert f"{wavelength / 10:.1f}".removesuffix(".0") in words
        assert "Hα" in words
        # Nothing is cut out of where the source is not.
        assert tab.locator("#pin .cutouts canvas").count() == 0
        tab.locator("#pin button", has_text="Show in the image").click()
        time.sleep(0.6)
        state = tab.evaluate("JSON.parse(decodeURIComponent(location.hash.slice(1))).images")
        assert (state["x"], state["y"]) == (330.0, 283.0)


def test_a_lake_that_is_published_anew_is_announced(browser, tmp_path):
    root = tmp_path / "lake"
    root.mkdir()
    published(root)
    with serving(root) as page, tab_of(browser, page) as tab:
        assert tab.locator("#changed").is_hidden()
        old = page.server.lake.key
        publish.make(root, plain_plan(2), plain_work)
        # The page looks by itself every half a minute, and whenever it is loaded.
        tab.reload()
        until(tab, "!document.getElementById('changed').hidden")
        assert page.server.lake.key == old
        tab.click("#reopen")
        until(tab, "document.body.dataset.ready === '1' && document.getElementById('changed').hidden")
        assert page.server.lake.key != old
        assert page.server.lake.key in tab.inner_text("#version")


def test_a_tab_is_told_of_what_another_has_opened(browser, tmp_path):
    root = tmp_path / "lake"
    root.mkdir()
    published(root)
    with serving(root) as page, tab_of(browser, page) as tab, tab_of(browser, page) as other:
        old = page.server.lake.key
        publish.make(root, plain_plan(2), plain_work)
        tab.reload()
        until(tab, "!document.getElementById('changed').hidden")
        tab.click("#reopen")
        until(tab, "document.body.dataset.ready === '1' && document.getElementById('changed').hidden")
        assert page.server.lake.key != old
        # What the page does every half a minute: nothing of the new lake gets between what is shown of the old one.
        learnt = "import('/static/api.js').then((api) => api.open()).then((lake) => lake.key)"
        assert [other.evaluate(learnt) for _ in range(2)] == [old] * 2
        assert other.is_visible("#changed")


def test_numbers_keep_their_digits(tab):
    tab.keyboard.press("3")
    whole = [999999999999, 1000000000001, 4503599627370497, 9007199254740991, 9007199254740993, -1234567890123]
    query = f"SELECT unnest({whole}) AS id, 150.1234567891::DOUBLE AS ra, 0.1::FLOAT AS x"
    tab.fill("#sql-text", query)
    tab.click("#sql-run")
    cells = (
        "[...document.querySelectorAll('#sql-result tbody td')].map((one) => one.textContent.replaceAll('\u202f', ''))"
    )
    until(tab, f"{cells}.length === 18")
    found = tab.evaluate(cells)
    assert found[::3] == [str(number) for number in whole]
    assert set(found[1::3]) == {"150.123456789"}
    assert set(found[2::3]) == {"0.1"}


def peaks(tab, page, number, most):
    """How many of the brightest stars that stand alone have the largest value of 3 x 3 pixels under the cursor."""
    tab.keyboard.press("4")
    until(tab, "document.getElementById('image-one').childElementCount === 3")
    tab.select_option("#image-one", str(number))
    time.sleep(1.5)
    truth, box = page.json(f"truth/{number}"), tab.locator("#image-canvas").bounding_box()
    place = np.array([truth["x"], truth["y"]]).T
    zoom = 0.98 * min(box["width"] / 700, box["height"] / 600)

    def value(column, row):
        tab.mouse.move(box["x"] + box["width"] / 2 - (column - 349.5) * zoom,
                       box["y"] + box["height"] / 2 + (row - 299.5) * zoom)  # fmt: skip
        text = tab.inner_text("#image-place").split("pixel ")[1]
        assert text.startswith(f"{column}, {row} ")
        return float(text.split("   ")[1].split(" electron")[0].replace("\N{NARROW NO-BREAK SPACE}", ""))

    alone = [at for k, at in enumerate(place) if (np.hypot(*(np.delete(place, k, 0) - at).T) > 14.0).all()]
    inside = [at for at in alone if 8 < at[0] < 690 and 8 < at[1] < 590][:most]
    for x, y in inside:
        column, row = round(x), round(y)
        near = {(i, j): value(column + i, row + j) for i in (-1, 0, 1) for j in (-1, 0, 1)}
        assert max(near, key=near.get) == (0, 0), (x, y, near)
    return len(inside)


def test_the_truth_is_where_pixels_peak_on_the_screen(tab, page):
    assert peaks(tab, page, 1, 8) == 8


@pytest.mark.nightly
def test_the_truth_of_all_is_where_pixels_peak_on_the_screen(tab, page):
    assert peaks(tab, page, 1, 200) > 80


def test_a_query_and_its_refusal(browser, page):
    with tab_of(browser, page) as tab:
        tab.keyboard.press("3")
        tab.fill("#sql-text", "SELECT id, ra, '<b>x</b>' AS text FROM galaxies ORDER BY id LIMIT 3")
        tab.press("#sql-text", "Control+Enter")
        until(tab, "document.getElementById('sql-state').textContent.startsWith('3 rows')")
        assert "ra deg" in tab.inner_text("#sql-result thead").replace("\t", " ").replace("\n", " ")
        # Text stays text.
        assert tab.locator("#sql-result b").count() == 0
        first = tab.inner_text("#sql-result tbody tr td")
        assert first.isdigit()
        assert len(first) > 16
        tab.click("#sql-plot")
        until(tab, "document.querySelectorAll('#plot-grid figure').length >= 1")
        until(tab, "document.getElementById('plot-state').textContent.startsWith('3 rows')")


def test_an_image_its_places_and_a_pinned_source(tab, page):
    tab.keyboard.press("4")
    until(tab, "document.getElementById('image-one').childElementCount === 3")
    tab.check("#image-truth")
    time.sleep(1.0)
    box = tab.locator("#image-canvas").bounding_box()
    truth = page.json("truth/0")
    zoom = 0.98 * min(box["width"] / 700, box["height"] / 600)
    # North is down in the file: it is shown turned.
    star = next(k for k in range(20) if 100 < truth["x"][k] < 600 and 100 < truth["y"][k] < 500)
    at = (box["x"] + box["width"] / 2 - (truth["x"][star] - 349.5) * zoom,
          box["y"] + box["height"] / 2 + (truth["y"][star] - 299.5) * zoom)  # fmt: skip
    tab.mouse.move(*at)
    place = until(tab, "document.getElementById('image-place').textContent")
    column, row = (int(text) for text in place.split("pixel ")[1].split("   ")[0].split(","))
    assert abs(column - truth["x"][star]) <= 1
    assert abs(row - truth["y"][star]) <= 1
    found = page.json(f"source/{truth['id'][star]}")
    ra, dec = (float(text) for text in place.split("\n")[0].split()[-3:-1])
    assert (ra, dec) == pytest.approx(found["place"], abs=2 * 0.1 / 3600)
    assert "electron" in place
    tab.mouse.click(*at)
    until(tab, f"document.getElementById('pin').textContent.includes('{truth['id'][star]}')")
    until(tab, "document.querySelectorAll('#pin .cutouts canvas').length === 2")


def test_the_address_holds_the_view(browser, page):
    with tab_of(browser, page) as tab:
        tab.keyboard.press("4")
        until(tab, "document.getElementById('image-one').childElementCount === 3")
        tab.select_option("#image-one", "1")
        tab.select_option("#image-map", "magma")
        tab.click("#theme")
        for _ in range(3):
            tab.keyboard.press("+")
        time.sleep(0.6)
        address = tab.evaluate("location.hash")
        assert page.gate.token not in address
        was = tab.evaluate("JSON.parse(decodeURIComponent(location.hash.slice(1))).images")
    with tab_of(browser, page, f"/{address}") as tab:
        until(tab, "!document.getElementById('images').hidden")
        until(tab, "document.getElementById('image-one').value === '1'")
        time.sleep(0.6)
        assert tab.evaluate("document.documentElement.dataset.theme") == "light"
        assert tab.evaluate("JSON.parse(decodeURIComponent(location.hash.slice(1))).images") == was


CONTRAST = """() => {
  const part = (v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
  const style = getComputedStyle(document.documentElement);
  const luminance = (name) => {
    const hex = style.getPropertyValue('--' + name).trim();
    return [1, 3, 5].map((k) => part(parseInt(hex.substr(k, 2), 16) / 255))
      .reduce((sum, v, k) => sum + v * [0.2126, 0.7152, 0.0722][k], 0);
  };
  const ratio = (a, b) => (Math.max(luminance(a), luminance(b)) + 0.05) / (Math.min(luminance(a), luminance(b)) + 0.05);
  return ['ink', 'quiet', 'accent', 'second', 'bad', 'good']
    .flatMap((a) => ['paper', 'panel', 'raised'].map((b) => [a, b, ratio(a, b)]));
}"""


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_contrast(tab, theme):
    if tab.evaluate("document.documentElement.dataset.theme") != theme:
        tab.click("#theme")
    assert [found for found in tab.evaluate(CONTRAST) if found[2] < 4.5] == []


NAMELESS = """() => [...document.querySelectorAll('button, input, select, textarea, canvas:not([aria-hidden])')]
  .filter((one) => one.checkVisibility() && !(one.labels?.length || one.textContent.trim() || one.title
    || one.getAttribute('aria-label') || one.closest('label'))).map((one) => one.outerHTML)"""


def test_every_control_has_a_name(tab):
    for number, view in enumerate(VIEWS, start=1):
        tab.keyboard.press(str(number))
        until(tab, f"!document.getElementById('{view}').hidden")
        time.sleep(0.5)
        assert tab.evaluate(NAMELESS) == []


# Text of each visible element against what lies behind it; a picture behind text has its own ground.
SEEN = """() => {
  const part = (v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
  const rgb = (text) => text.match(/[\\d.]+/g).map(Number);
  const luminance = (c) => c.slice(0, 3).map((v) => part(v / 255))
    .reduce((s, v, k) => s + v * [0.2126, 0.7152, 0.0722][k], 0);
  const behind = (one) => {
    for (let at = one; at; at = at.parentElement) {
      const c = rgb(getComputedStyle(at).backgroundColor);
      if (c.length < 4 || c[3] === 1) return c;
    }
    return [255, 255, 255];
  };
  return [...document.querySelectorAll('body *')].filter((one) => one.checkVisibility() && !one.disabled
      && [...one.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim()))
    .map((one) => {
      const a = luminance(rgb(getComputedStyle(one).color)), b = luminance(behind(one));
      return [one.tagName, one.textContent.slice(0, 40), (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05)];
    }).filter((one) => one[2] < 4.5);
}"""


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_text_can_be_read_where_it_stands(tab, theme):
    if tab.evaluate("document.documentElement.dataset.theme") != theme:
        tab.click("#theme")
    for number, view in enumerate(VIEWS, start=1):
        tab.keyboard.press(str(number))
        until(tab, f"!document.getElementById('{view}').hidden")
        time.sleep(0.4)
        assert tab.evaluate(SEEN) == []


@pytest.mark.nightly
def test_everything_is_reached_by_keys(tab):
    """Tab leads to every control of a view, and what has the focus can be seen."""
    for view in VIEWS[:4]:
        tab.click(f"#tab-{view}")
        time.sleep(0.8)
        wanted = tab.evaluate(
            f"[...document.querySelectorAll('#{view} button, #{view} input, #{view} select, #{view} canvas[tabindex]')]"
            ".filter((one) => one.checkVisibility() && !one.disabled).length"
        )
        reached = set()
        for _ in range(wanted + 40):
            tab.keyboard.press("Tab")
            reached.add(tab.evaluate(
                f"(() => {{ const a = document.activeElement, all = [...document.querySelectorAll('#{view} *')];"
                "return all.indexOf(a); })()"
            ))  # fmt: skip
            if tab.evaluate("document.activeElement !== document.body"):
                assert tab.evaluate("getComputedStyle(document.activeElement).outlineStyle !== 'none'")
        assert len(reached - {-1}) >= wanted


@pytest.mark.nightly
def test_nothing_moves_where_that_is_asked_for(browser, page):
    with tab_of(browser, page, reduced_motion="reduce") as tab:
        tab.keyboard.press("4")
        until(tab, "document.getElementById('image-one').childElementCount === 3")
        tab.select_option("#image-two", "1")
        time.sleep(1.0)
        tab.click("#image-blink")
        time.sleep(0.8)
        once = tab.locator("#image-canvas").screenshot()
        time.sleep(1.7)
        assert tab.locator("#image-canvas").screenshot() == once
