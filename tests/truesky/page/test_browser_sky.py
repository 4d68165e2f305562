"""The sky in a browser: footprints by state, from the sky to a pixel, keys, captions, requests."""

import json
import tomllib

import numpy as np
import pytest

from tests.truesky.page.browsing import HELD, at, copied, plain, tab_of, until
from tests.truesky.page.conftest import CENTRE, PIXEL, system
from truesky.page import sky_maps
from truesky.render.camera import astrometry
from truesky.request.from_toml import from_table

STATES = "document.getElementById('sky-states').textContent"
LEGEND = "document.getElementById('sky-legend').textContent"
TABLE = "[...document.querySelectorAll('#sky-data td')].map((one) => one.textContent).join()"
TOLD = "document.getElementById('told').textContent"
CLIPBOARD = {"permissions": ["clipboard-read", "clipboard-write"]}


def gone_to(tab, place=CENTRE):
    tab.fill("#sky-go", f"{place[0]} {place[1]}")
    tab.press("#sky-go", "Enter")
    until(tab, f"{LEGEND}.includes('individual')")


@pytest.mark.nightly
def test_footprints_by_state(browser, sky):
    with tab_of(browser, sky) as tab:
        until(tab, f"{STATES} === 'tasks planned: 2 observed: 1'")
        seen = tab.locator("#sky .stage").screenshot()
        for kind, told in (("products", "observed: 1"), ("exposures", "planned: 1 partly: 1")):
            tab.select_option("#sky-footprints", kind)
            until(tab, f"{STATES} === '{kind} {told}'")
            now = tab.locator("#sky .stage").screenshot()
            assert now != seen
            seen = now
        until(tab, f"{HELD}.sky.footprints === 'exposures'")
        tab.select_option("#sky-footprints", "nothing")
        until(tab, f"{STATES} === ''")
        tab.select_option("#sky-table", "coverage of euclid_vis")
        until(tab, f"{LEGEND}.includes('planned exposures')")


def test_from_the_sky_to_a_pixel_and_back(browser, sky):
    with tab_of(browser, sky) as tab:
        gone_to(tab)
        until(tab, f"{STATES}.includes('observed')")
        box = tab.locator("#sky-canvas").bounding_box()
        # Wheel events have whole pixels as coordinates.
        tab.mouse.move(round(box["x"] + box["width"] / 2), round(box["y"] + box["height"] / 2))
        told = until(tab, "document.getElementById('sky-place').textContent")
        aimed = [float(text) for text in told.split("\n")[0].split()[-3:-1]]
        for _ in range(40):
            tab.mouse.wheel(0, -120)
            if tab.is_visible("#images"):
                break
        until(tab, f"{HELD}.view === 'images' && {HELD}.images.one >= 0 && {HELD}.images.zoom > 0")
        there = tab.evaluate(f"{HELD}.images")
        (x,), (y,) = astrometry.pixel_of_sky(system(), *np.array(aimed).reshape(2, 1))
        assert (there["x"], there["y"]) == pytest.approx((x, y), abs=1)
        # The image is as large as it was on the sky: 0.01 deg fill at least 90 % of the height.
        assert there["zoom"] * 0.01 / PIXEL >= tab.locator("#image-canvas").bounding_box()["height"] * 0.9
        tab.click("#image-sky")
        until(tab, f"{HELD}.view === 'sky'")
        there = tab.evaluate(f"{HELD}.sky")
        assert (there["ra"], there["dec"]) == pytest.approx(aimed, abs=2 * PIXEL)


@pytest.mark.nightly
def test_keys_announce_the_position_pin_and_open(browser, sky):
    with tab_of(browser, sky) as tab:
        truth = sky.json("truth/0")
        star = next(k for k in range(20) if 100 < truth["x"][k] < 600 and 100 < truth["y"][k] < 500)
        place = sky.json(f"source/{truth['id'][star]}")["place"]
        gone_to(tab, place)
        tab.locator("#sky-canvas").focus()
        for _ in range(8):
            tab.keyboard.press("+")
        tab.keyboard.press("ArrowLeft")
        tab.keyboard.press("ArrowRight")
        assert until(tab, f"{TOLD}.includes('deg') && {TOLD}").split()[-3:-1] == pytest.approx(
            [f"{number:.6f}" for number in place]
        )
        tab.keyboard.press("Enter")
        until(tab, f"document.getElementById('pin').textContent.includes('{truth['id'][star]}')")
        tab.keyboard.press("o")
        until(tab, f"{HELD}.view === 'images'")


@pytest.mark.nightly
def test_an_open_table_follows_the_map(browser, sky):
    with tab_of(browser, sky) as tab:
        until(tab, f"{LEGEND}.includes('deg')")
        tab.click("#sky-to-table")
        before = until(tab, TABLE)
        gone_to(tab)
        until(tab, f"{TABLE} !== {json.dumps(before)}")
        heads = tab.evaluate("[...document.querySelectorAll('#sky-data th')].map((one) => one.textContent)")
        assert heads[:2] == ["id", "RA deg"]


@pytest.mark.nightly
def test_captions_count_omitted_sources_and_cells(browser, sky, monkeypatch):
    with tab_of(browser, sky) as tab:
        tab.select_option("#sky-table", "stars")
        gone_to(tab)
        caption = "document.querySelector('#sky-legend > div:last-child').textContent"
        whole = plain(until(tab, f"{caption}.includes('individual') && {caption}")).split()[0]
        monkeypatch.setattr(sky_maps, "MAX_SOURCES", 100)
        tab.fill("#sky-where", "dec > -90")
        tab.press("#sky-where", "Enter")
        until(tab, f"{LEGEND}.includes('the brightest 100')")
        assert f"the brightest 100 by mag_h of {whole} sources" in plain(tab.evaluate(caption))


@pytest.mark.nightly
def test_the_copied_request_covers_the_view(browser, sky):
    with tab_of(browser, sky, **CLIPBOARD) as tab:
        gone_to(tab)
        until(tab, f"{STATES}.includes('observed')")
        request = from_table(tomllib.loads(copied(tab, "#sky-request")))
        assert (request.area.ra, request.area.dec) == pytest.approx(CENTRE, abs=1e-6)
        assert request.area.radius == pytest.approx(tab.evaluate(f"{HELD}.sky.height") / 2)
        first, second = request.pointings
        assert (first.channel, first.camera, first.band) == ("VIS", "vis", "euclid_vis")
        assert (first.detectors, second.detectors) == (("1-1", "1-2"), ("3-4",))
        assert (second.position_angle, second.mjd, second.exposure_time_s) == (12.5, 60906.5, 90.0)
        # The request for an image contains only its exposure and detector.
        tab.keyboard.press("4")
        until(tab, f"{HELD}.images?.one >= 0 && {HELD}.images.zoom > 0")
        request = from_table(tomllib.loads(copied(tab, "#image-request")))
        assert [one.detectors for one in request.pointings] == [("1-1",)]
        assert (request.area.ra, request.area.dec) == pytest.approx(CENTRE, abs=3 * PIXEL)
        # A copied query selects the rows in view.
        tab.keyboard.press("1")
        assert copied(tab, "#sky-sql").startswith("SELECT *\nFROM galaxies\nWHERE separation(ra, dec, ")


PLACES = """([ra, dec]) => import('/static/api.js').then((api) => ra.map((one, k) => api.place(one, dec[k])))"""


@pytest.mark.nightly
def test_places_have_the_digits_of_a_hundredth_of_an_arcsecond(browser, page):
    rng = np.random.default_rng(2)
    ra, dec = rng.uniform(0.0, 360.0, 500), rng.uniform(-90.0, 90.0, 500)
    ra[:4], dec[:4] = [359.99999999, 0.0, 359.9999, 15.0 - 1e-9], [-1e-9, 89.9999999, -0.5, 30.0 - 1e-9]
    with tab_of(browser, page, at("sql")) as tab:
        texts = tab.evaluate(PLACES, [ra.tolist(), dec.tolist()])
    for lon, lat, text in zip(ra, dec, texts, strict=True):
        hours, angles, degrees, declination, _ = text.replace("\N{MINUS SIGN}", "-").split()
        h, m, s = (float(part) for part in hours.split(":"))
        d, n, t = (float(part) for part in angles.lstrip("+-").split(":"))
        assert h < 24, text
        assert max(m, s, n, t) < 60, text
        sign = -1 if angles.startswith("-") else 1
        for found in (
            (15 * (h + m / 60 + s / 3600), sign * (d + n / 60 + t / 3600)),
            (float(degrees), float(declination)),
        ):
            away = (found[0] - lon + 180.0) % 360.0 - 180.0
            assert abs(away) * 3600 < 0.01, text
            assert abs(found[1] - lat) * 3600 < 0.01, text
        assert float(degrees) < 360.0
