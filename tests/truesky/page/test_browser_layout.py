"""The layout of every view on a phone and on a desk, and the rules of axe-core for accessibility."""

from itertools import product

import pytest

from tests.truesky.page.browsing import DRAWN, VIEWS, at, tab_of, until

SIZES = {"phone": {"width": 390, "height": 844}, "desk": {"width": 1280, "height": 800}}
# For the visible view: how far the page is too wide (pixels), whether the footer overlaps the view, and the fraction of
# the picture (map or image) that legends cover. The page is scrolled to its end.
LAYOUT = """() => {
  scrollTo(0, document.documentElement.scrollHeight);
  const view = [...document.querySelectorAll('main > section')].find((one) => one.checkVisibility());
  const footer = document.querySelector('footer').getBoundingClientRect();
  const shown = [...view.querySelectorAll('*')].filter((one) => one.checkVisibility() && !one.closest('.data, aside'));
  const low = Math.max(...shown.map((one) => one.getBoundingClientRect().bottom));
  const picture = view.querySelector('.stage canvas')?.getBoundingClientRect();
  const covered = [...view.querySelectorAll('.legend')].map((one) => one.getBoundingClientRect()).map((one) =>
    Math.max(0, Math.min(one.right, picture.right) - Math.max(one.left, picture.left))
    * Math.max(0, Math.min(one.bottom, picture.bottom) - Math.max(one.top, picture.top)));
  return {
    wide: document.documentElement.scrollWidth - innerWidth,
    overlap: low - footer.top, below: innerHeight - footer.bottom,
    covered: picture ? covered.reduce((a, b) => a + b, 0) / (picture.width * picture.height) : 0,
  };
}"""


@pytest.fixture(scope="module", params=SIZES)
def sized(browser, page, request):
    """The name of a size, and a tab of this size."""
    with tab_of(browser, page, at("sql"), viewport=SIZES[request.param]) as opened:
        yield request.param, opened


@pytest.mark.parametrize("view", VIEWS)
def test_nothing_covers_a_view(sized, view):
    size, tab = sized
    tab.click(f"#tab-{view}")
    until(tab, DRAWN[view])
    found = tab.evaluate(LAYOUT)
    assert found["wide"] <= 0
    if size == "phone":
        # The page scrolls: the footer is behind the content, and legends are beside the picture.
        assert found["overlap"] <= 1
        assert abs(found["below"]) < 2
        assert found["covered"] == 0
    else:
        # The footer is at the lower end of the window, and views scroll inside.
        assert abs(found["below"]) < 2
        assert found["covered"] < 0.1


# A view of each size and each theme; the others are tested at night.
DAILY = {("phone", "dark", "images"), ("desk", "light", "sql")}


@pytest.mark.parametrize(
    ("sized", "theme", "view"),
    [
        pytest.param(*one, marks=() if one in DAILY else pytest.mark.nightly)
        for one in product(SIZES, ("dark", "light"), VIEWS)
    ],
    indirect=["sized"],
)
def test_axe_finds_no_violation(sized, view, theme):
    """The rules of axe-core, among them contrast, names and roles of controls, landmarks and the order of headings."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    _, tab = sized
    if tab.evaluate("document.documentElement.dataset.theme") != theme:
        tab.click("#theme")
    tab.click(f"#tab-{view}")
    until(tab, DRAWN[view])
    results = axe.run(tab).response
    assert len(results["passes"]) > 20
    violations = [(one["id"], [node["html"] for node in one["nodes"]][:3]) for one in results["violations"]]
    assert violations == []


def test_a_phone_scrolls_over_charts(browser, page):
    """A vertical drag with a finger over a chart scrolls the page; the browser leaves horizontal ones to the brush."""
    with tab_of(browser, page, at("plots"), viewport=SIZES["phone"], has_touch=True, is_mobile=True) as tab:
        until(tab, DRAWN["plots"])
        assert tab.evaluate("getComputedStyle(document.querySelector('#plot-grid canvas')).touchAction") == "pan-y"
