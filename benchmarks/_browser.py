"""Measure times of the web page in a browser: until the first sky map is shown, and until charts follow a brush.

A brush is a range on the axis of a chart that selects rows in all other charts.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from statistics import median, quantiles
from typing import Any

CHROMIUM = os.environ.get("TRUESKY_CHROMIUM") or shutil.which("chromium")
# Longest time in seconds to wait for the page.
_TIMEOUT = 120.0
# Seconds after which the server has certainly counted all positions of a brush.
_PAUSE = 3.0
# JavaScript that moves the brush of the first chart with a key or the pointer. It returns the times in ms until the
# other charts show other numbers, and until the browser has drawn them.
_MOVE = """async ([kind, facts]) => {
  const [canvas] = document.querySelectorAll('#plot-grid canvas'), box = canvas.getBoundingClientRect();
  const text = () => [...document.querySelectorAll('#plot-grid .range')].slice(1).map((one) => one.textContent).join();
  const was = text(), started = performance.now();
  if (kind === 'key') canvas.dispatchEvent(new KeyboardEvent('keydown', { ...facts, bubbles: true }));
  else canvas.dispatchEvent(new PointerEvent('pointermove', { clientX: box.left + facts.place * box.width,
    clientY: box.top + box.height / 2, pointerId: 1, buttons: 1, bubbles: true }));
  while (text() === was && performance.now() - started < 5000) await new Promise((done) => setTimeout(done, 0));
  const counted = performance.now() - started;
  await new Promise((done) => requestAnimationFrame(done));
  return [counted, performance.now() - started];
}"""


def missing_requirement() -> str:
    """Return a message if Playwright or Chromium is missing, or "" if a browser can be used."""
    if importlib.util.find_spec("playwright") is None:
        return "playwright is not installed (make .venv/installed-test)"
    return "" if CHROMIUM else "there is no chromium (Debian: apt install chromium)"


@contextmanager
def _open_tab() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser.new_page(viewport={"width": 1280, "height": 800})
        browser.close()


def _wait_until(tab: Any, expression: str) -> None:
    end = time.monotonic() + _TIMEOUT
    while not tab.evaluate(expression):
        if time.monotonic() > end:
            raise TimeoutError(expression)
        time.sleep(0.01)


def time_first_sky(command: Sequence[str]) -> float:
    """Start a server of the page with a command, and return the time (s) until a browser shows the first sky map.

    The browser is started before. TimeoutError is raised after 120 s.
    """
    with _open_tab() as tab:
        started = time.perf_counter()
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
            try:
                assert server.stdout is not None
                tab.goto(server.stdout.readline().split()[-1])
                _wait_until(tab, "document.getElementById('sky-legend').textContent !== ''")
                return time.perf_counter() - started
            finally:
                server.terminate()


def time_brushes(address: str, times: int) -> dict[str, float]:
    """Measure how long charts take to follow the movements of a brush.

    Parameters
    ----------
    address : str
        Address of the page of a lake whose table `trial` has columns x_0 to x_3.
    times : int
        Number of movements with keys, and number of movements with the pointer.

    Returns
    -------
    dict of str to float
        Times in milliseconds: `cube_ms` (median while the brush is held with the pointer, for which the page has all
        counts), `brush_1m_ms` and `brush_1m_95_ms` (median and 95 % quantile for keys, each with an HTTP request).
    """
    with _open_tab() as tab:
        tab.goto(address)
        _wait_until(tab, "document.body.dataset.ready === '1'")
        tab.keyboard.press("2")
        tab.fill("#plot-source", "trial")
        tab.press("#plot-source", "Enter")
        tab.evaluate("() => document.getElementById('plot-source').dispatchEvent(new Event('change'))")
        _wait_until(tab, "document.getElementById('plot-state').textContent.includes('rows')")
        # Move the brush right and left in turn, because it cannot move beyond the end of the axis.
        keys = ["ArrowRight" if k % 16 < 8 else "ArrowLeft" for k in range(times)]
        key_times = [tab.evaluate(_MOVE, ["key", {"key": key}]) for key in keys][1:]
        box = tab.locator("#plot-grid canvas").first.bounding_box()
        tab.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 0.5 * box["height"])
        tab.mouse.down()
        tab.mouse.move(box["x"] + 0.35 * box["width"], box["y"] + 0.5 * box["height"])
        # When the pointer is pressed, the page requests the counts for all positions of the brush. Wait for them.
        time.sleep(_PAUSE)
        drag_times = [tab.evaluate(_MOVE, ["drag", {"place": 0.4 + 0.5 * k / times}]) for k in range(times)]
        tab.mouse.up()
    return {
        "cube_ms": median(durations[0] for durations in drag_times),
        "brush_1m_ms": median(durations[1] for durations in key_times),
        "brush_1m_95_ms": quantiles((durations[1] for durations in key_times), n=20)[-1],
    }
