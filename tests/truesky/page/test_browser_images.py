"""Images in a browser: pixels, positions, true sources, a pinned source."""

import time

import numpy as np
import pytest

from tests.truesky.page import test_traces
from tests.truesky.page.browsing import HELD, at, canvas_colours, tab_of, until
from tests.truesky.page.conftest import serving
from truesky.page import pictures

VIEW = "images"


@pytest.mark.nightly
def test_a_source_through_the_grism(browser, tmp_path):
    root = tmp_path / "lake"
    root.mkdir()
    own, wavelength = test_traces.published(root)
    with serving(root) as page, tab_of(browser, page, at(VIEW)) as tab:
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
        # There are no cutouts, because the light is not at the position of the source.
        assert tab.locator("#pin .cutouts canvas").count() == 0
        tab.locator("#pin button", has_text="Show in the image").click()
        time.sleep(0.6)
        state = tab.evaluate("JSON.parse(decodeURIComponent(location.hash.slice(1))).images")
        assert (state["x"], state["y"]) == (330.0, 283.0)


def peaks(tab, page, number, most):
    """Check that the pixel under each of `most` bright isolated stars is the largest of 3 x 3; return their number."""
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


@pytest.mark.nightly
def test_true_sources_are_drawn_at_peaks_of_pixels(tab, page):
    assert peaks(tab, page, 1, 8) == 8


@pytest.mark.nightly
def test_all_true_sources_are_drawn_at_peaks_of_pixels(tab, page):
    assert peaks(tab, page, 1, 200) > 80


def test_an_image_its_places_and_a_pinned_source(tab, page):
    until(tab, "document.getElementById('image-one').childElementCount === 3")
    tab.check("#image-truth")
    time.sleep(1.0)
    box = tab.locator("#image-canvas").bounding_box()
    truth = page.json("truth/0")
    zoom = 0.98 * min(box["width"] / 700, box["height"] / 600)
    # North is down in the file, so the image is shown rotated.
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


def opened(tab):
    """Show the images; return the box of the canvas and the zoom at which the whole first image is visible."""
    until(tab, f"document.getElementById('image-one').childElementCount === 3 && {HELD}.images?.zoom > 0")
    box = tab.locator("#image-canvas").bounding_box()
    return box, 0.98 * min(box["width"] / 700, box["height"] / 600)


@pytest.mark.nightly
def test_the_number_of_marked_sources_is_shown_if_there_are_many(tab, page, monkeypatch):
    total = page.json("truth/0")["total"]
    monkeypatch.setattr(pictures.bright_sources, "__defaults__", (40,))
    opened(tab)
    tab.check("#image-truth")
    until(tab, f"document.getElementById('image-legend').textContent.includes('the brightest 40 of {total}')")


@pytest.mark.nightly
def test_the_description_of_a_source_stays_with_the_cursor(tab, page):
    box, zoom = opened(tab)
    tab.check("#image-truth")
    until(tab, "document.getElementById('image-legend').textContent.includes('sources')")
    truth = page.json("truth/0")
    star = next(k for k in range(20) if 100 < truth["x"][k] < 600 and 100 < truth["y"][k] < 500)
    at = (box["x"] + box["width"] / 2 - (truth["x"][star] - 349.5) * zoom,
          box["y"] + box["height"] / 2 + (truth["y"][star] - 299.5) * zoom)  # fmt: skip
    tab.mouse.move(*at)
    tip = "document.getElementById('image-tip').textContent"
    assert truth["id"][star] in until(tab, f"{tip}.includes('mag_h') && {tip}")
    tab.mouse.move(at[0] + 1, at[1])
    assert "mag_h" in tab.evaluate(tip)


@pytest.mark.nightly
def test_keys_announce_pixels_and_pin_sources(tab, page):
    opened(tab)
    tab.check("#image-truth")
    until(tab, "document.getElementById('image-legend').textContent.includes('sources')")
    tab.locator("#image-canvas").focus()
    place = "document.getElementById('image-place').textContent"
    truth = page.json("truth/0")
    # The star nearest to the centre, which some tens of steps of one pixel reach.
    away = np.hypot(np.array(truth["x"]) - 349.5, np.array(truth["y"]) - 299.5)
    star = int(np.argmin(away))
    for _ in range(6):
        tab.keyboard.press("+")
    tab.keyboard.press("Shift+ArrowLeft")
    told = until(tab, place)
    column, row = (int(text) for text in told.split("pixel ")[1].split("   ")[0].split(","))
    for steps, more, less in (
        (truth["x"][star] - column, "ArrowLeft", "ArrowRight"),
        (truth["y"][star] - row, "ArrowDown", "ArrowUp"),
    ):
        for _ in range(round(abs(steps))):
            # North is down in the file, so the image is shown rotated.
            tab.keyboard.press(f"Shift+{more if steps > 0 else less}")
    told = tab.evaluate(place)
    column, row = (int(text) for text in told.split("pixel ")[1].split("   ")[0].split(","))
    assert (column, row) == (pytest.approx(truth["x"][star], abs=1), pytest.approx(truth["y"][star], abs=1))
    assert "electron" in told
    until(tab, f"document.getElementById('told').textContent.includes('{truth['id'][star]}')")
    tab.keyboard.press("Enter")
    until(tab, f"document.getElementById('pin').textContent.includes('{truth['id'][star]}')")
    # Positions in the table have enough digits for 0.01 arcsec, and every column has a description.
    tab.locator("#pin summary").first.click()
    words = tab.locator("#pin details[open]").first.inner_text()
    assert f"{page.json(f'''source/{truth['id'][star]}''')['place'][0]:.7f}" in words
    assert "right ascension" in words


def test_cosmic_rays_come_and_go(tab):
    box, zoom = opened(tab)
    # A pixel at the edge of the hits of 5000 electrons. Without the hits, its value comes from its surroundings.
    at = box["x"] + box["width"] / 2 - (120 - 349.5) * zoom, box["y"] + box["height"] / 2 + (200 - 299.5) * zoom
    place = "document.getElementById('image-place').textContent"

    value = f"Number({place}.split('   ').pop().split(' electron')[0].replace('\u202f', ''))"
    tab.mouse.move(*at)
    # The value under the cursor changes when tiles arrive.
    until(tab, f"{place}.includes('pixel 120, 200') && Math.abs({value} - 100) < 50")
    tab.evaluate("document.getElementById('image-mended').click()")
    until(tab, f"Math.abs({value} - 5100) < 50")
    tab.locator("#image-canvas").focus()
    tab.keyboard.press("c")
    assert tab.locator("#image-mended").is_checked()


@pytest.mark.nightly
def test_blinking_shows_both_in_turn(tab):
    opened(tab)
    tab.select_option("#image-two", "1")
    time.sleep(1.0)
    tab.keyboard.press("b")
    # Compare the last screenshots: on a busy machine, the first ones may show tiles that are still loading.
    shown = []
    for _ in range(24):
        shown.append(tab.locator("#image-canvas").screenshot())
        time.sleep(0.25)
        if len(shown) > 8 and len(set(shown[-8:])) == 2:
            break
    assert len(set(shown[-8:])) == 2
    tab.click("#image-blink")
    assert tab.get_attribute("#image-blink", "aria-pressed") == "false"
