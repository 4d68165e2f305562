"""Queries in a browser: results with all digits, and refusals."""

import pytest

from tests.truesky.page.browsing import at, tab_of, until, write_query

VIEW = "sql"


def test_numbers_keep_their_digits(tab):
    whole = [999999999999, 1000000000001, 4503599627370497, 9007199254740991, 9007199254740993, -1234567890123]
    query = f"SELECT unnest({whole}) AS id, 150.1234567891::DOUBLE AS ra, 0.1::FLOAT AS x"
    write_query(tab, query)
    tab.click("#sql-run")
    cells = (
        "[...document.querySelectorAll('#sql-result tbody td')].map((one) => one.textContent.replaceAll('\u202f', ''))"
    )
    until(tab, f"{cells}.length === 18")
    found = tab.evaluate(cells)
    assert found[::3] == [str(number) for number in whole]
    assert set(found[1::3]) == {"150.123456789"}
    assert set(found[2::3]) == {"0.1"}


def test_a_query_and_its_refusal(browser, page):
    with tab_of(browser, page, at(VIEW)) as tab:
        write_query(tab, "SELECT id, ra, '<b>x</b>' AS text FROM galaxies ORDER BY id LIMIT 3")
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


@pytest.mark.nightly
def test_an_error_clears_the_previous_result(browser, page):
    with tab_of(browser, page, at(VIEW), refused="/sql") as tab:
        until(tab, "document.querySelectorAll('#sql-result td').length > 0")
        write_query(tab, "SELECT redshift FROM galaxies")
        tab.click("#sql-run")
        until(tab, "document.getElementById('sql-state').className === 'bad-text'")
        assert "use z_obs" in tab.inner_text("#sql-state")
        assert tab.locator("#sql-result *").count() == 0
        assert tab.get_attribute("#sql-result", "aria-busy") == "false"


@pytest.mark.nightly
def test_a_running_query_is_shown(tab):
    until(tab, "document.querySelectorAll('#sql-result td').length > 0")
    waiting = []
    tab.route("**/sql", lambda route: waiting.append(route))
    write_query(tab, "SELECT 1 AS one")
    tab.press("#sql-text", "Control+Enter")
    until(tab, "document.getElementById('sql-state').textContent === 'Running…'")
    assert tab.get_attribute("#sql-result", "aria-busy") == "true"
    while not waiting:
        tab.wait_for_timeout(20)
    waiting[0].continue_()
    until(tab, "document.getElementById('sql-state').textContent.startsWith('1 rows')")
    assert tab.get_attribute("#sql-result", "aria-busy") == "false"


@pytest.mark.nightly
def test_the_editor_completes_and_highlights(tab):
    until(tab, "document.querySelectorAll('#sql-result td').length > 0")
    write_query(tab, "SELECT 1 FROM galaxies WHERE ")
    tab.press("#sql-text", "Control+End")
    options = "[...document.getElementById('sql-editor').shadowRoot.querySelectorAll('.cm-completionLabel')]"
    tab.keyboard.type("bulge_half")
    until(tab, f"{options}.some((one) => one.textContent === 'bulge_half_light_radius')")
    # CodeMirror ignores Enter in the first moment of a list.
    tab.wait_for_timeout(200)
    tab.keyboard.press("Enter")
    written = "document.getElementById('sql-editor').shadowRoot.querySelector('.cm-content').textContent"
    until(tab, f"{written} === 'SELECT 1 FROM galaxies WHERE bulge_half_light_radius'")
    # A digit is text, not the key of a view.
    tab.keyboard.type(" > 1")
    assert tab.is_visible("#sql")
    write_query(tab, "SELECT count(*) FROM ")
    tab.press("#sql-text", "Control+End")
    tab.keyboard.press("Control+Space")
    until(tab, f"{options}.some((one) => one.textContent === 'galaxy_fluxes')")
    # Escape closes the list, and Tab leaves the editor.
    tab.keyboard.press("Escape")
    until(tab, f"{options}.length === 0")
    tab.keyboard.press("Tab")
    assert tab.evaluate("document.activeElement.id") == "sql-run"
    colours = (
        "new Set([...document.getElementById('sql-editor').shadowRoot.querySelectorAll('.cm-line span')]"
        ".map((one) => getComputedStyle(one).color)).size"
    )
    write_query(tab, "SELECT 'text', 17 -- remark")
    until(tab, f"{colours} >= 4")
    assert "SELECT" in tab.get_attribute("#sql-text", "aria-label")


@pytest.mark.nightly
def test_names_have_their_ucds_beside_them(tab):
    until(tab, "document.querySelectorAll('#sql-result td').length > 0")
    assert "pos.eq.ra" in tab.inner_text("#sql-result thead")
    tab.locator("#sql-schema summary", has_text="galaxies").click()
    assert "pos.eq.dec" in tab.locator("#sql-schema details[open]").inner_text()


@pytest.mark.nightly
def test_a_download_that_is_refused_says_why(browser, page):
    with tab_of(browser, page, at(VIEW), refused="/export?", accept_downloads=True) as tab:
        until(tab, "document.querySelectorAll('#sql-result td').length > 0")
        came = []
        tab.on("download", lambda download: came.append(download))
        state = "document.getElementById('sql-state').textContent"
        write_query(tab, "SELECT nothing FROM galaxies")
        tab.click("[data-format=csv]")
        until(tab, f"{state}.includes('nothing')")
        assert "bad-text" in tab.get_attribute("#sql-state", "class")
        assert came == []
        write_query(tab, "SELECT 7 AS seven")
        with tab.expect_download() as begun:
            tab.click("[data-format=csv]")
        assert begun.value.suggested_filename == "result.csv"
        with open(begun.value.path(), encoding="utf-8") as file:
            assert file.read().split() == ['"seven"', "7"]


@pytest.mark.nightly
def test_the_browser_takes_over_a_large_download(browser, page):
    with tab_of(browser, page, at(VIEW), accept_downloads=True) as tab:
        until(tab, "document.querySelectorAll('#sql-result td').length > 0")
        write_query(tab, "SELECT repeat('0123456789', 100) AS x FROM range(40000)")
        with tab.expect_download() as begun:
            tab.click("[data-format=csv]")
        assert begun.value.url.startswith("http")
        assert begun.value.path().stat().st_size > 40_000_000


@pytest.mark.nightly
def test_the_last_of_overlapping_queries_is_shown(tab):
    until(tab, "document.querySelectorAll('#sql-result td').length > 0")
    write_query(tab, "SELECT sum(a.range * b.range) AS slow FROM range(40000) a, range(10000) b")
    tab.click("#sql-run")
    write_query(tab, "SELECT 1 AS fast")
    with tab.expect_response(lambda answer: "/sql" in answer.url and "slow" in answer.request.post_data):
        tab.click("#sql-run")
        until(tab, "document.querySelector('#sql-result th').textContent === 'fast'")
    tab.wait_for_timeout(200)
    assert tab.inner_text("#sql-result th") == "fast"
