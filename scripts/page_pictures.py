"""Take screenshots of the web page of truesky for the documentation.

    python -m scripts.page_pictures FOLDER

The page shows the lake (folder of tables and images) that `make demo` has made. Playwright (extra `test`) controls the
Chromium of the system, which takes the screenshots. Both must be installed.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
LAKE = ROOT / "out" / "demo" / "lake"
CHROMIUM = os.environ.get("TRUESKY_CHROMIUM") or shutil.which("chromium")
_TOKEN = "a-token-of-the-pictures"  # noqa: S105  (of the server that this program starts on 127.0.0.1)
# Size of the browser window, pixels.
_SIZE = {"width": 1400, "height": 860}
# Longest time that `wait_until` waits, s.
_LONGEST = 60.0


def missing_requirement() -> str:
    """Return a message if Playwright, Chromium or the lake of `make demo` is missing, or "" if nothing is missing."""
    if importlib.util.find_spec("playwright") is None:
        return "playwright is not installed (make .venv/installed-test)"
    if CHROMIUM is None:
        return "Chromium is not installed (Debian: apt install chromium)"
    return "" if LAKE.is_dir() else f"{LAKE} does not exist (make demo)"


@contextmanager
def serve_page(lake: Path) -> Iterator[str]:
    """Run the server of the web page for a lake during a `with` block, and yield the address of the page."""
    command = [sys.executable, "-m", "truesky.page", str(lake), "--no-open", "--token", _TOKEN]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            yield server.stdout.readline().split()[-1]
        finally:
            server.terminate()


def wait_until(tab: Any, expression: str) -> Any:
    """Wait until a JavaScript expression is true in a browser tab, and return its value.

    The expression is evaluated every 50 ms, because the page forbids the eval that Playwright's wait needs.
    TimeoutError is raised after 60 s.
    """
    end = time.monotonic() + _LONGEST
    while not (value := tab.evaluate(expression)):
        if time.monotonic() > end:
            raise TimeoutError(expression)
        time.sleep(0.05)
    return value


def _sky(tab: Any) -> None:
    wait_until(tab, "document.getElementById('sky-legend').textContent !== ''")
    time.sleep(2.0)


def _plots(tab: Any) -> None:
    wait_until(tab, "document.getElementById('plot-state').textContent.includes('rows')")
    box = tab.locator("#plot-grid canvas").first.bounding_box()
    tab.mouse.move(box["x"] + 0.35 * box["width"], box["y"] + 80)
    tab.mouse.down()
    tab.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 80, steps=6)
    tab.mouse.up()
    time.sleep(1.5)


def _sql(tab: Any) -> None:
    wait_until(tab, "document.querySelectorAll('#sql-result td').length > 0")
    tab.locator("#sql-schema details summary").nth(2).click()


def _images(tab: Any) -> None:
    wait_until(tab, "document.getElementById('image-one').childElementCount > 0")
    tab.check("#image-truth")
    time.sleep(4.0)
    box = tab.locator("#image-canvas").bounding_box()
    # Point at a bright star with a galaxy next to it, given as fractions of the width and height of the image.
    x, y = box["x"] + 0.755 * box["width"], box["y"] + 0.823 * box["height"]
    tab.mouse.move(x, y)
    for _ in range(8):
        tab.mouse.wheel(0, -120)
        time.sleep(0.15)
    time.sleep(1.5)
    tab.mouse.click(x, y)
    wait_until(tab, "document.querySelectorAll('#pin .cutouts canvas').length > 0")
    wait_until(tab, "document.querySelector('#pin canvas.spectrum') !== null")
    time.sleep(2.0)


def _runs(tab: Any) -> None:
    wait_until(tab, "document.querySelectorAll('#runs-content h2').length > 2")
    tab.locator("#runs-content details summary").first.click()
    time.sleep(1.0)


VIEWS: tuple[tuple[str, str, Callable[[Any], None]], ...] = (
    ("sky", "Galaxies a square degree, and what of the sky is observed", _sky),
    ("plots", "Histograms and maps under a brush in redshift", _plots),
    ("sql", "A query, with the names that it can use", _sql),
    ("images", "A VIS image without its cosmic rays, the true sources on it, one of them pinned", _images),
    ("runs", "What the jobs took, and what an image was made of", _runs),
)


def pictures(into: Path) -> list[tuple[str, str]]:
    """Take the screenshots, write them to the existing folder `into`, and return their file names and captions.

    RuntimeError is raised if the page reports an error in the browser's console.
    """
    from playwright.sync_api import sync_playwright

    files = []
    faults: list[str] = []
    with serve_page(LAKE) as address, sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        tab = browser.new_page(viewport=_SIZE)
        tab.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
        tab.on("pageerror", lambda error: faults.append(str(error)))
        tab.goto(address)
        wait_until(tab, "document.body.dataset.ready === '1'")
        for name, caption, show in VIEWS:
            tab.click(f"#tab-{name}")
            show(tab)
            tab.screenshot(path=into / f"page_{name}.png")
            files.append((f"page_{name}.png", caption))
        tab.click("#theme")
        tab.click("#tab-plots")
        time.sleep(1.5)
        tab.screenshot(path=into / "page_light.png")
        files.append(("page_light.png", "The same histograms in the light theme"))
        browser.close()
    if faults:
        raise RuntimeError(f"the page has errors: {faults}")
    return files


def main() -> None:
    """Run the command; SystemExit with a message is raised if a requirement is missing."""
    if why := missing_requirement():
        raise SystemExit(f"truesky: {why}")
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for name, _ in pictures(folder):
        print(folder / name)


if __name__ == "__main__":
    main()
