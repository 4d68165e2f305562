"""Charts in a browser: brushes, samples, points, tables."""

import time

import numpy as np
import pytest

from lake_schema.store import read
from tests.truesky.page.browsing import at, drag, plain, tab_of, until
from tests.truesky.page.conftest import GALAXIES_N
from truesky.page import charts

VIEW = "plots"
RANGES = "[...document.querySelectorAll('#plot-grid .range')].map((one) => one.textContent)"


def test_brushes_filter_the_other_charts(tab, shown):
    ranges = RANGES
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
    # The map of the same column against another is also filtered.
    assert tab.evaluate(ranges)[4] != whole[4]
    tab.locator("#plot-grid canvas").first.focus()
    tab.keyboard.press("Escape")
    until(tab, f"{ranges}[1] === {whole[1]!r}")
    for _ in range(3):
        tab.keyboard.press("Shift+ArrowRight")
    until(tab, f"{ranges}[1] !== {whole[1]!r}")


@pytest.mark.nightly
def test_a_held_brush_sends_no_requests(tab):
    until(tab, "document.getElementById('plot-state').textContent.includes('rows')")
    asked, answered = [], []
    tab.on("request", lambda request: asked.append(request.url))
    tab.on("requestfinished", lambda request: answered.append(request.url))
    mouse = drag(tab, "#plot-grid canvas", 0.3, 0.35)
    # Wait for the requests that were sent when the brush was grabbed.
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


@pytest.mark.nightly
def test_an_error_clears_the_charts(browser, page):
    with tab_of(browser, page, at(VIEW), refused="/charts") as tab:
        until(tab, f"{RANGES}.every((text) => text.includes('rows'))")
        drawn = tab.locator("#plot-grid canvas").first.screenshot()
        tab.fill("#plot-where", "redshift > 1")
        tab.press("#plot-where", "Enter")
        until(tab, "document.getElementById('plot-state').className === 'bad-text'")
        assert "use z_obs" in tab.inner_text("#plot-state")
        assert set(tab.evaluate(RANGES)) == {""}
        assert tab.locator("#plot-grid canvas").first.screenshot() != drawn
        assert tab.get_attribute("#plot-grid", "aria-busy") == "false"
        tab.fill("#plot-where", "z_obs > 1")
        tab.press("#plot-where", "Enter")
        until(tab, f"{RANGES}.every((text) => text.includes('rows'))")
        assert tab.get_attribute("#plot-state", "class") == "quiet"


@pytest.mark.nightly
def test_a_computation_is_shown(tab):
    until(tab, f"{RANGES}.every((text) => text.includes('rows'))")
    waiting = []
    tab.route("**/charts", lambda route: waiting.append(route))
    tab.fill("#plot-where", "z_obs > 1")
    tab.press("#plot-where", "Enter")
    until(tab, "document.getElementById('plot-state').textContent === 'Computing…'")
    assert tab.get_attribute("#plot-grid", "aria-busy") == "true"
    until(tab, "document.getElementById('told').textContent === 'Computing the charts'")
    waiting[0].continue_()
    until(tab, "document.getElementById('plot-state').textContent.includes('rows')")
    assert tab.get_attribute("#plot-grid", "aria-busy") == "false"


@pytest.mark.nightly
def test_a_sample_is_counted_first_if_there_are_many_rows(browser, page, monkeypatch):
    monkeypatch.setattr(charts, "ROWS_PER_CORE", 10)
    with tab_of(browser, page, at(VIEW)) as tab:
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


@pytest.mark.nightly
def test_a_map_as_points(tab, shown):
    ranges = "[...document.querySelectorAll('#plot-grid figure.map .range')].map((one) => one.textContent)"
    until(tab, f"{ranges}[0].includes('per bin')")
    before = tab.locator("#plot-grid figure.map canvas").first.screenshot()
    tab.locator("#plot-grid figure.map button", has_text="points").first.click()
    text = until(tab, f"{ranges}[0].includes('points') && {ranges}[0]").replace("\N{NARROW NO-BREAK SPACE}", "")
    rows, points = (int(text.split(f" {word}")[0].split()[-1]) for word in ("rows", "points"))
    assert 0 < points == rows <= GALAXIES_N
    assert tab.locator("#plot-grid figure.map canvas").first.screenshot() != before
    until(tab, "JSON.parse(decodeURIComponent(location.hash.slice(1))).plots.charts[4].points === true")


@pytest.mark.nightly
def test_charts_are_tables_too(tab):
    """Tables of the sky, of a histogram, of a map and of the bands of a spectrum contain the numbers of the charts."""
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
        # The table of a map contains only the fullest bins.
        assert sum(numbers) == int(total) if place == 0 else 0 < sum(numbers) <= int(total)


@pytest.mark.nightly
def test_a_table_that_is_open_follows_its_chart(tab):
    until(tab, f"{RANGES}.every((text) => text.includes('rows'))")
    figure = tab.locator("#plot-grid figure").nth(1)
    figure.locator("button", has_text="Table").click()
    whole = tab.evaluate(RANGES)[1]
    drag(tab, "#plot-grid canvas", 0.3, 0.6).up()
    until(tab, f"{RANGES}[1] !== {whole!r}")
    cells = "[...document.querySelectorAll('#plot-grid figure')[1].querySelectorAll('td:last-child')]"
    shown = f"{cells}.reduce((sum, one) => sum + Number(one.textContent.replaceAll('\u202f', '')), 0)"
    until(tab, f"{shown} === Number({RANGES}[1].replaceAll('\u202f', '').split(' rows')[0])")


@pytest.mark.nightly
def test_rows_outside_all_bins_are_counted_for_every_axis(tab, shown):
    galaxies = read.version(shown, "galaxies").rows(["z_obs", "mag_r01"])
    z = galaxies["z_obs"].to_numpy()
    bound = float(np.median(z))
    # The column has a long tail, which the axis cuts off.
    source = f"(SELECT exp(3 * z_obs) AS w, CASE WHEN z_obs > {bound} THEN mag_r01 END AS m FROM galaxies) AS t"
    tab.evaluate(f"import('/static/plots.js').then((plots) => plots.usePlot({source!r}, [['w', 'm'], ['w']]))")
    text = plain(until(tab, f"{RANGES}.length === 2 && {RANGES}.every((text) => text.includes('rows')) && {RANGES}[0]"))
    lost = int((~(z > bound)).sum())
    assert f"{lost} of all rows without m" in text
    rows, outside = (int(text.split(f" {word}")[0].split()[-1]) for word in ("rows", "outside"))
    assert rows + outside + lost == GALAXIES_N
    text = plain(tab.evaluate(RANGES)[1])
    assert int(text.split(" rows")[0]) + int(text.split(" outside")[0].split()[-1]) == GALAXIES_N
    assert "without" not in text


@pytest.mark.nightly
def test_screen_readers_announce_a_moved_brush_once(tab):
    until(tab, f"{RANGES}.every((text) => text.includes('rows'))")
    assert tab.locator("#plots [aria-live], #plots [role=status]").count() == 0
    tab.locator("#plot-grid canvas").first.focus()
    for _ in range(4):
        tab.keyboard.press("Shift+ArrowRight")
    until(tab, "document.getElementById('told').textContent.includes(' to ')")
