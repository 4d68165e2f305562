"""The page in a browser: every view, the address, themes, keys; no error, and no request to another host."""

import re
import shutil
import time
from pathlib import Path

import pytest

import truesky.page as page_package
from lake_schema.store import publish
from tests.truesky.page.browsing import DRAWN, VIEWS, at, canvas_colours, tab_of, until
from tests.truesky.page.conftest import serving
from tests.universe import plain_plan, plain_work
from tests.waiting import PATIENCE


def until_colours(tab, selector, fewest):
    """Wait until a screenshot of an element has more colours."""
    end = time.monotonic() + PATIENCE
    while canvas_colours(tab, selector) <= fewest:
        assert time.monotonic() < end, selector
        time.sleep(0.1)


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
            until_colours(tab, "#image-canvas", 30)
        if view == "runs":
            until(tab, "document.querySelectorAll('#runs-content h2').length > 2")


def test_all_modules_are_asked_for_at_once():
    static = Path(page_package.__file__).with_name("static")
    text = (static / "index.html").read_text()
    # The editor of queries is large, and is loaded with the view that needs it.
    assert set(re.findall(r'modulepreload" href="/static/(\w+)\.js"', text)) | {"app", "codemirror"} == {
        path.stem for path in static.glob("*.js")
    }


def test_the_first_sky_waits_for_no_other_question(tab):
    asked = "performance.getEntriesByType('resource').filter((one) => /(regions|bands|parts)$/.test(one.name))"
    until(tab, f"{asked}.length === 3 && {asked}.every((one) => one.responseEnd > 0)")
    times = tab.evaluate(f"Object.fromEntries({asked}.map((one) => [one.name.split('/').pop(), one.startTime]))")
    assert times["parts"] == min(times.values())


def test_a_new_version_of_the_lake_is_announced(browser, shown, tmp_path):
    root = shutil.copytree(shown, tmp_path / "lake", symlinks=True)
    with serving(root) as page, tab_of(browser, page, at("sql")) as tab:
        assert tab.locator("#changed").is_hidden()
        old = page.server.lake.key
        publish.make_version(root, plain_plan(2), plain_work)
        # The page checks for new versions every half a minute, and whenever it is loaded.
        tab.reload()
        until(tab, "!document.getElementById('changed').hidden")
        assert page.server.lake.key == old
        tab.click("#reopen")
        until(tab, "document.body.dataset.ready === '1' && document.getElementById('changed').hidden")
        assert page.server.lake.key != old
        assert page.server.lake.key in tab.inner_text("#version")


@pytest.mark.nightly
def test_a_tab_is_notified_if_another_tab_opens_a_new_version(browser, shown, tmp_path):
    root = shutil.copytree(shown, tmp_path / "lake", symlinks=True)
    with serving(root) as page, tab_of(browser, page, at("sql")) as tab, tab_of(browser, page, at("sql")) as other:
        old = page.server.lake.key
        publish.make_version(root, plain_plan(2), plain_work)
        tab.reload()
        until(tab, "!document.getElementById('changed').hidden")
        tab.click("#reopen")
        until(tab, "document.body.dataset.ready === '1' && document.getElementById('changed').hidden")
        assert page.server.lake.key != old
        # The page makes this request every half a minute. It must not mix data of the new lake into the old one.
        learnt = "import('/static/api.js').then((api) => api.open()).then((lake) => lake.key)"
        assert [other.evaluate(learnt) for _ in range(2)] == [old] * 2
        assert other.is_visible("#changed")


@pytest.mark.nightly
def test_the_address_holds_the_view(browser, page):
    with tab_of(browser, page, at("images")) as tab:
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


@pytest.fixture(scope="module")
def any_view(browser, page):
    """Return a tab for tests that change only the view and the theme."""
    with tab_of(browser, page, at("sql")) as opened:
        yield opened


def in_theme(tab, theme):
    if tab.evaluate("document.documentElement.dataset.theme") != theme:
        tab.click("#theme")
    return tab


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_contrast(any_view, theme):
    tab = in_theme(any_view, theme)
    assert [found for found in tab.evaluate(CONTRAST) if found[2] < 4.5] == []


NAMELESS = """() => [...document.querySelectorAll('button, input, select, textarea, canvas:not([aria-hidden])')]
  .filter((one) => one.checkVisibility() && !(one.labels?.length || one.textContent.trim() || one.title
    || one.getAttribute('aria-label') || one.closest('label'))).map((one) => one.outerHTML)"""


# Contrast of the text of each visible element with its background. Text over a picture has a background colour.
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


@pytest.mark.parametrize("theme", [pytest.param("dark", marks=pytest.mark.nightly), "light"])
def test_every_control_has_a_name_and_text_can_be_read_where_it_stands(any_view, theme):
    tab = in_theme(any_view, theme)
    for number, view in enumerate(VIEWS, start=1):
        tab.keyboard.press(str(number))
        until(tab, f"!document.getElementById('{view}').hidden && {DRAWN[view]}")
        assert tab.evaluate(NAMELESS) == []
        assert tab.evaluate(SEEN) == []


@pytest.mark.nightly
def test_everything_is_reached_by_keys(tab):
    """The key Tab reaches every control of a view, and the control with the focus is visible."""
    for view in VIEWS:
        tab.click(f"#tab-{view}")
        time.sleep(0.8)
        wanted = tab.evaluate(
            f"[...document.querySelectorAll('#{view} button, #{view} input, #{view} select, "
            f"#{view} canvas[tabindex], #{view} summary')]"
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
def test_animations_stop_if_reduced_motion_is_preferred(browser, page):
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
