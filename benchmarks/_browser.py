"""The page in a browser with a clock: when its first sky is shown, how soon a move of a brush is."""

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
_TIMEOUT, _PAUSE = 120.0, 3.0
# A move of the brush of the first chart: ms until the other charts show other numbers, and until a frame with them.
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
    """What there is not, "" where there is a browser."""
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
    """s from a command that serves a lake to the legend of its sky."""
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
    """Moves of a brush over four histograms and a map: held, and counted anew.

    address : of a page over a lake whose table `trial` has columns x_0 to x_3;  times : how many moves
    """
    with _open_tab() as tab:
        tab.goto(address)
        _wait_until(tab, "document.body.dataset.ready === '1'")
        tab.keyboard.press("2")
        tab.fill("#plot-source", "trial")
        tab.press("#plot-source", "Enter")
        tab.evaluate("() => document.getElementById('plot-source').dispatchEvent(new Event('change'))")
        _wait_until(tab, "document.getElementById('plot-state').textContent.includes('rows')")
        # To and fro: beyond the end of an axis nothing changes.
        keys = ["ArrowRight" if k % 16 < 8 else "ArrowLeft" for k in range(times)]
        key_times = [tab.evaluate(_MOVE, ["key", {"key": key}]) for key in keys][1:]
        box = tab.locator("#plot-grid canvas").first.bounding_box()
        tab.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 0.5 * box["height"])
        tab.mouse.down()
        tab.mouse.move(box["x"] + 0.35 * box["width"], box["y"] + 0.5 * box["height"])
        # The counts for every place of the brush.
        time.sleep(_PAUSE)
        drag_times = [tab.evaluate(_MOVE, ["drag", {"place": 0.4 + 0.5 * k / times}]) for k in range(times)]
        tab.mouse.up()
    return {
        "cube_ms": median(durations[0] for durations in drag_times),
        "brush_1m_ms": median(durations[1] for durations in key_times),
        "brush_1m_95_ms": quantiles((durations[1] for durations in key_times), n=20)[-1],
    }
