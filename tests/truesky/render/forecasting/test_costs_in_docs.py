"""The costs in the documentation agree with the forecast within 30 %."""

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest

from truesky.render.forecasting import request_cost
from truesky.render.forecasting.image_costs import ImageCosts
from truesky.render.forecasting.speed import Speed
from truesky.render.plan_exposures import Planner
from truesky.request.from_toml import from_table, parse

ROOT = Path(__file__).resolve().parents[4]
DOCS = ROOT / "docs"
# The machine whose costs are printed: an AMD EPYC.
MACHINE = Speed(0.61, "")
ERROR = 0.3
UNITS = {"s": 1.0, "min": 60.0, "h": 3600.0, "kB": 1e3, "MB": 1e6, "GB": 1e9, "TB": 1e12}
AMOUNT = r"([\d.,]+) (s|min|h|kB|MB|GB|TB)"
SENTENCE = re.compile(
    rf"Cost: ([\d,]+) images, {AMOUNT} of CPU time, {AMOUNT} on disc; with an empty cache {AMOUNT} more and {AMOUNT} "
    "of cache"
)
ROW = re.compile(r"\| \[(\w+)\]\(\.\./requests/\w+\.toml\) \| ([\d,]+) \| " + r" \| ".join([AMOUNT] * 4) + r" \|")


@dataclass
class Cost:
    """Cost of a request: images, CPU seconds and bytes of a run, and those of the products made once."""

    images: int
    cpu_s: float
    disc: float
    once_s: float
    cache: float


@pytest.fixture(autouse=True)
def empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TRUESKY_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache" / "numba"))


def forecast(request):
    images = ImageCosts(request)
    for _ in images.watch(Planner.from_request(None, request).tables()):
        pass
    cost = request_cost.forecast(request, images, MACHINE)
    once = sum(item.cpu_s for item in cost.items)
    return Cost(cost.detectors, cost.cpu_s - once, cost.lake_bytes, once, cost.cache_bytes)


def stated(groups):
    images, *amounts = groups
    numbers = [float(number.replace(",", "")) * UNITS[unit] for number, unit in zip(*[iter(amounts)] * 2, strict=True)]
    return Cost(int(images.replace(",", "")), *numbers)


def agree(text, cost):
    for name, value in vars(cost).items():
        assert getattr(text, name) == pytest.approx(value, rel=ERROR, abs=0.5), name


def test_the_first_example_is_cheap_and_its_cost_is_stated():
    page = " ".join((DOCS / "own_field.md").read_text().split("\n"))
    (match,) = SENTENCE.finditer(page)
    (example, *_) = re.findall(r"```toml\n(.*?)```", (DOCS / "own_field.md").read_text(), re.DOTALL)
    cost = forecast(from_table(tomllib.loads(example)))
    agree(stated(match.groups()), cost)
    assert cost.cpu_s + cost.once_s < 300.0
    assert cost.disc < 1e9


ROWS = {match[1]: match.groups()[1:] for match in ROW.finditer((DOCS / "command.md").read_text())}


def test_the_table_contains_every_shipped_request():
    assert {*ROWS} == {path.stem for path in (ROOT / "requests").glob("*.toml")}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.nightly] * name.startswith(("sc8", "pilot", "vis")))
        for name in sorted(ROWS)
    ],
)
def test_the_costs_of_shipped_requests(name):
    agree(stated(ROWS[name]), forecast(parse(ROOT / "requests" / f"{name}.toml")))
