"""Late and refused answers in a browser: the latest request is shown, and errors are displayed.

Answers are delayed or replaced in the page, so that no request fails.
"""

import json
import tomllib

import pytest

from tests.truesky.page.browsing import HELD, at, copied, tab_of, until
from tests.truesky.page.conftest import CENTRE
from tests.truesky.page.test_browser_sky import CLIPBOARD, LEGEND, STATES, gone_to
from tests.truesky.page.test_requests import REQUESTS, two  # noqa: F401
from truesky.page import sky_maps
from truesky.request.from_toml import from_table

# First view of the tests. Most tests leave it at once, and it is the fastest to draw.
VIEW = "sql"
SAID = "document.getElementById('said').textContent"
PIN = "document.querySelector('#pin h2')?.textContent"
# Delay the first `times` answers from addresses with `part` by `delay` ms; then refuse them if `error` is given.
REPLACED = """([part, delay, error, times]) => {
  const real = window.fetch;
  window.fetch = async (address, options) => {
    if (!String(address).includes(part) || times-- < 1) return real(address, options);
    await new Promise((done) => setTimeout(done, delay));
    return error ? new Response(JSON.stringify({ error }), { status: 429 }) : real(address, options);
  };
}"""


def replaced(tab, part, delay=0, error=None, times=1):
    tab.evaluate(REPLACED, [part, delay, error, times])


@pytest.mark.nightly
def test_the_later_of_two_pinned_sources_is_shown(tab, page):
    first, second = page.json("truth/0")["id"][:2]
    replaced(tab, f"source/{first}", 700)
    both = f"import('/static/pin.js').then(({{ pin }}) => Promise.all([pin('{first}'), pin('{second}')]).then(() => 1))"
    assert tab.evaluate(both) == 1
    assert second in tab.evaluate(PIN)
    assert tab.evaluate("import('/static/pin.js').then(({ pinned }) => pinned().id)") == second


@pytest.mark.nightly
def test_refused_true_sources_are_requested_again(tab):
    tab.keyboard.press("4")
    until(tab, f"document.getElementById('image-one').childElementCount === 3 && {HELD}.images?.zoom > 0")
    replaced(tab, "truth/0", 0, "try again later")
    tab.check("#image-truth")
    until(tab, f"{SAID}.includes('try again later')")
    tab.uncheck("#image-truth")
    tab.check("#image-truth")
    until(tab, "document.getElementById('image-legend').textContent.includes('sources')")


@pytest.mark.nightly
def test_a_source_is_described_again_on_another_image(tab):
    """A source on two images that blink has different numbers on each."""
    told = tab.evaluate("""async () => {
      const truth = await import('/static/truth.js'), real = window.fetch;
      window.fetch = async (address, options) => {
        const number = String(address).match(/truth\\/([89])$/)?.[1];
        if (!number) return real(address, options);
        return Response.json({ id: ["5"], x: [7], y: [7], kind: ["star"], expected: [Number(number)], drawn: [0] });
      };
      document.getElementById('image-truth').checked = true;
      const found = [];
      for (const number of [8, 9]) {
        await truth.asked({ number });
        truth.tip({ number }, [7, 7], 5, [0, 0]);
        found.push(document.getElementById('image-tip').textContent.split("\\n")[1]);
      }
      window.fetch = real;
      return found;
    }""")
    assert [text.split()[0] for text in told] == ["8", "9"]


@pytest.mark.nightly
def test_textures_of_late_tiles_are_deleted(tab):
    """Tiles may arrive after other tiles have replaced them in the cache."""
    made, kept, textures = tab.evaluate("""async () => {
      const { Tiles } = await import('/static/tiles.js'), gl = new Proxy({ textures: 0 }, { get: (own, name) => {
        if (name === "textures") return own.textures;
        if (name === "createTexture") return () => (own.textures++, {});
        if (name === "deleteTexture") return () => own.textures--;
        return () => 0;
      } });
      const real = window.fetch, answers = [];
      window.fetch = () => new Promise((done) => answers.push(() => done(new Response(new ArrayBuffer(4)))));
      const tiles = new Tiles(gl, () => 0), image = { number: 0, tile: 1, levels: [[200, 1]] };
      for (let k = 0; k < 150; k++) tiles.get(image, 0, 0, k, false);
      answers.forEach((answer) => answer());
      await new Promise((done) => setTimeout(done, 300));
      window.fetch = real;
      return [answers.length, tiles.kept.size, gl.textures];
    }""")
    assert made == 150
    assert kept == textures < 150


def test_refusals_are_shown(tab):
    replaced(tab, "/api/reopen", 0, "the lake is busy")
    tab.evaluate("document.getElementById('reopen').click()")
    until(tab, f"{SAID}.includes('the lake is busy')")
    tab.keyboard.press("5")
    until(tab, "document.querySelectorAll('#runs-content details').length === 3")
    replaced(tab, "provenance/0", 0, "nobody knows")
    tab.locator("#runs-content summary").first.click()
    until(tab, f"{SAID}.includes('nobody knows')")
    tab.locator("#runs-content summary").first.click()
    tab.locator("#runs-content summary").first.click()
    until(tab, "document.querySelector('#runs-content details').textContent.includes('version')")


@pytest.mark.nightly
def test_a_refused_source_of_the_sky_is_shown(tab, page):
    truth = page.json("truth/0")
    place = page.json(f"source/{truth['id'][0]}")["place"]
    tab.keyboard.press("1")
    gone_to(tab, place)
    replaced(tab, "/source/", 0, "no place in the queue")
    tab.locator("#sky-canvas").focus()
    for _ in range(8):
        tab.keyboard.press("+")
    tab.keyboard.press("Enter")
    until(tab, f"{SAID}.includes('no place in the queue')")


@pytest.mark.nightly
def test_a_removed_brush_selects_nothing(tab):
    tab.keyboard.press("2")
    until(tab, "[...document.querySelectorAll('#plot-grid .range')].every((one) => one.textContent.includes('rows'))")
    canvas = "document.querySelector('#plot-grid canvas')"
    box = tab.locator("#plot-grid canvas").first.bounding_box()
    tab.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 40)
    tab.mouse.down()
    tab.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 40, steps=4)
    until(tab, f"{HELD}.plots.charts[0].brush")
    tab.evaluate(f"{canvas}.dispatchEvent(new PointerEvent('pointercancel'))")
    plots = "import('/static/plots.js').then(({ state }) => JSON.stringify(state().charts[0].brush))"
    brush = tab.evaluate(plots)
    tab.mouse.move(box["x"] + 0.8 * box["width"], box["y"] + 40, steps=4)
    assert tab.evaluate(plots) == brush != "null"
    tab.mouse.up()


BRUSHED = """import('/static/plots.js').then((plots) => plots.restore({ source: 'galaxies', where: 'z_obs > 1 -- far',
  charts: [{ axes: [{ expression: 'z_obs -- z', log: false }], spans: null, brush: [[1, 2]] }] }))"""


@pytest.mark.nightly
def test_copied_queries_keep_conditions_that_end_in_a_comment(browser, page):
    with tab_of(browser, page, **CLIPBOARD) as tab:
        until(tab, f"{LEGEND}.includes('deg')")
        tab.fill("#sky-where", "z_obs > 1 -- far")
        tab.press("#sky-where", "Enter")
        queries = [copied(tab, "#sky-sql")]
        tab.keyboard.press("Escape")
        tab.locator("#tab-plots").click()
        tab.fill("#plot-where", "z_obs > 1 -- far")
        tab.press("#plot-where", "Tab")
        tab.evaluate(BRUSHED)
        queries.append(copied(tab, "#plot-sql"))
        for query in queries:
            assert "-- far" in query
            found = page.json("sql", method="POST", body=json.dumps({"sql": query}).encode())
            assert found["rows"]
        # Without charts there is no plot to copy.
        tab.evaluate("import('/static/plots.js').then((plots) => plots.usePlot('galaxies', []))")
        tab.click("#plot-python")
        until(tab, f"{SAID}.includes('There is no chart.')")


DOTS = """async ([mag, sense]) => {
  const { drawDots, firstOf } = await import('/static/marks.js'), radii = [];
  const c = { beginPath() {}, fill() {}, arc: (x, y, radius) => radii.push(radius) };
  drawDots(c, { ra: mag, dec: mag, mag, sense }, () => [0, 0], "red");
  return [firstOf({ sense }), ...radii];
}"""


def test_the_first_sources_are_the_largest(tab):
    name, heavy, light, none = tab.evaluate(DOTS, [[14.5, 11.0, None], -1])
    assert (name, heavy > none > light > 0) == ("most massive", True)
    name, bright, faint = tab.evaluate(DOTS, [[-1.0, 20.0], 1])
    assert (name, bright > faint > 0) == ("brightest", True)


@pytest.mark.nightly
def test_only_exposures_in_view_are_shown_if_there_are_many(browser, sky, monkeypatch):
    monkeypatch.setattr(sky_maps, "MAX_EXPOSURES", 1)
    with tab_of(browser, sky, refused="/exposures") as tab:
        until(tab, f"{STATES}.includes('observed')")
        tab.select_option("#sky-footprints", "exposures")
        until(tab, f"{STATES} === 'exposuresmore than 1 exposures are in view: use a smaller field'")
        tab.fill("#sky-go", f"{CENTRE[0]} {CENTRE[1]}")
        tab.press("#sky-go", "Enter")
        tab.locator("#sky-canvas").focus()
        for _ in range(8):
            tab.keyboard.press("+")
        until(tab, f"{STATES} === 'exposures partly: 1'")


# ------------------------------------------------------------------------------------------------ two requests

TRACES = """async ([identifier, number]) => {
  const api = await import('/static/api.js'), { drawTraces } = await import('/static/trace.js'), said = [];
  const get = (own, name) => (name === "fillText" ? (text, x) => said.push([text, x]) : () => 0);
  const c = new Proxy({}, { get, set: () => true });
  drawTraces(c, await api.get(`source/${identifier}`), await api.get(`image/${number}`), (x, y) => [x, y]);
  return said.filter(([text]) => text === "order 1").map(([, x]) => x);
}"""


@pytest.mark.nightly
def test_traces_and_copied_requests_belong_to_the_request_of_the_image(browser, two):  # noqa: F811
    page, identifier = two
    with tab_of(browser, page, at("images"), **CLIPBOARD) as tab:
        for number, (*_, first, _) in enumerate(REQUESTS.values()):
            assert tab.evaluate(TRACES, [str(identifier), number]) == [first]
        until(tab, f"{HELD}.images?.zoom > 0")
        for number, (band, *_) in enumerate(REQUESTS.values()):
            tab.select_option("#image-one", str(number))
            until(tab, f"{HELD}.images.one === {number}")
            request = from_table(tomllib.loads(copied(tab, "#image-request")))
            assert [(one.band, one.detectors) for one in request.pointings] == [(band, ("DET22",))]
        # The copied queries name the tables of the request.
        tab.evaluate(f"import('/static/pin.js').then(({{ pin }}) => pin('{identifier}'))")
        queries = [copied(tab, "#pin button:has-text('Copy as SQL')")]
        tab.keyboard.press("1")
        tab.select_option("#sky-table", "coverage of nisp_blue")
        queries.append(copied(tab, "#sky-sql"))
        for query, rows in zip(queries, (1, 2), strict=True):
            found = page.json("sql", method="POST", body=json.dumps({"sql": query}).encode())
            assert len(found["rows"]) >= rows
        # The request for a field contains the exposures that cover it, with their positions and bands.
        far = REQUESTS["b"][1]
        tab.keyboard.press("1")
        tab.fill("#sky-go", f"{far} {CENTRE[1]}")
        tab.press("#sky-go", "Enter")
        request = from_table(tomllib.loads(copied(tab, "#sky-request")))
        assert [(one.band, one.ra, one.mjd) for one in request.pointings] == [("nisp_blue", far, 61001.0)]


@pytest.mark.nightly
def test_names_of_footprints_at_one_position_do_not_overlap(browser, two):  # noqa: F811
    page, _ = two
    with tab_of(browser, page) as tab:
        until(tab, f"{STATES}.includes('observed')")
        said = tab.evaluate("""async () => {
          const { drawFootprints } = await import('/static/footprints.js'), said = [];
          const get = (own, name) => (name === "fillText" ? (text, x, y) => said.push([text, x, y]) : () => 0);
          const c = new Proxy({}, { get, set: () => true });
          drawFootprints(c, "products", { height: 1 }, () => [50, 50], [100, 100]);
          return said;
        }""")
        assert [text.partition(":")[0] for text, *_ in said] == ["a", "b"]
        assert abs(said[0][2] - said[1][2]) >= 12
