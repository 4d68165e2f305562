"""Functions for tests of the page in a browser."""

import io
import json
import time
from contextlib import contextmanager, suppress
from urllib.parse import quote

import numpy as np
from matplotlib.image import imread

from tests.waiting import PATIENCE


def at(view):
    """Return the address of a view, so that the default view is not drawn first."""
    return "/#" + quote(json.dumps({"view": view}))


VIEWS = ("sky", "plots", "sql", "images", "runs")
# Conditions that hold when a view has drawn its first result.
DRAWN = {
    "sky": "document.getElementById('sky-legend').textContent.includes('deg')",
    "plots": "document.getElementById('plot-state').textContent.includes('rows')",
    "sql": "document.querySelectorAll('#sql-result td').length > 0"
    " && document.getElementById('sql-editor').shadowRoot.querySelector('.cm-content')",
    "images": "document.getElementById('image-legend').textContent.includes('electron')",
    "runs": "document.querySelectorAll('#runs-content h2').length > 2",
}
# The security policy stops what markup of a stranger would run or load. The page must not even try.
VIOLATED = "addEventListener('securitypolicyviolation', (event) => console.error(`policy: ${event.blockedURI}`))"
# State of the page, which is stored in its address.
HELD = "JSON.parse(decodeURIComponent(location.hash.slice(1)))"


def until(tab, expression):
    """Wait for an expression without eval, which the security policy of the page forbids."""
    end = time.monotonic() + PATIENCE
    while True:
        # While a page is loading, expressions raise an error of the browser.
        with suppress(Exception):
            if value := tab.evaluate(expression):
                return value
        assert time.monotonic() < end, expression
        time.sleep(0.03)


@contextmanager
def tab_of(browser, page, address="/", refused=None, **context):
    """Yield the page in a tab that has its cookie. At the end, only errors that the test expects may have occurred.

    `refused` is a part of the addresses whose requests the test expects to fail.
    """
    faults = []
    opened = browser.new_context(**{"viewport": {"width": 1280, "height": 800}, **context})
    opened.add_init_script(VIOLATED)
    tab = opened.new_page()
    tab.on("dialog", lambda dialog: faults.append(f"dialog {dialog.message}"))
    tab.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
    tab.on("pageerror", lambda error: faults.append(str(error)))

    def lost(request):
        # Requests in progress are aborted when the tab leaves an address.
        if request.failure != "net::ERR_ABORTED":
            faults.append(f"{request.url} {request.failure}")

    tab.on("requestfailed", lost)
    tab.on("response", lambda answer: faults.append(f"{answer.url} {answer.status}") if answer.status >= 400 else None)
    own = (page.origin + "/", "data:", "blob:")
    tab.on("request", lambda request: None if request.url.startswith(own) else faults.append(request.url))
    if address == "/":
        tab.goto(f"{page.origin}/?token={page.gate.token}")
    else:
        # With the cookie that the token would bring, the page is loaded once.
        cookie = {"name": page.gate.cookie, "value": page.gate.token, "url": page.origin}
        opened.add_cookies([{**cookie, "httpOnly": True, "sameSite": "Strict"}])
        tab.goto(page.origin + address)
    until(tab, "document.body.dataset.ready === '1'")
    yield tab
    # Requests in progress fail when the tab closes, which is not a fault of the page.
    wrong = [one for one in faults if refused is None or not ("status of 400" in one or refused in one)]
    opened.close()
    assert wrong == []


def write_query(tab, text):
    """Replace the query in the editor, as a user does; a function of the browser for this would insert styles."""
    tab.click("#sql-text")
    tab.keyboard.press("Control+A")
    tab.keyboard.press("Delete")
    tab.keyboard.insert_text(text)


def canvas_colours(tab, selector):
    """Return the number of colours in a screenshot of an element."""
    pixels = imread(io.BytesIO(tab.locator(selector).first.screenshot()), format="png")[..., :3]
    return len(np.unique(pixels.reshape(-1, 3), axis=0))


def drag(tab, selector, first, last):
    """Drag over a canvas between two fractions of its width."""
    box = tab.locator(selector).first.bounding_box()
    y = box["y"] + 0.4 * box["height"]
    tab.mouse.move(box["x"] + first * box["width"], y)
    tab.mouse.down()
    for part in np.linspace(first, last, 12):
        tab.mouse.move(box["x"] + part * box["width"], y)
    return tab.mouse


def plain(text):
    """Return a text without separators of thousands in its numbers."""
    return text.replace("\N{NARROW NO-BREAK SPACE}", "")


def copied(tab, selector):
    """Return the text that a button copies to the clipboard."""
    tab.evaluate("navigator.clipboard.writeText('')")
    tab.click(selector)
    return until(tab, "navigator.clipboard.readText()")
