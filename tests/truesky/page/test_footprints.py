"""Footprints of exposures and detectors, and the number of exposures that cover a position."""

import numpy as np
import pytest

from lake_schema import sky
from lake_schema.store import publish
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.exposures import EXPOSURES
from lake_schema.tables.products import PRODUCTS
from lake_schema.tables.tasks import TASKS
from tests.truesky.page.conftest import serving, unpacked
from tests.universe import rows_of
from truesky.page import sky_maps


def square(ra, dec):
    return f"POLYGON ICRS {ra} {dec} {ra + 1} {dec} {ra + 1} {dec + 1} {ra} {dec + 1}"


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    """Exposures of one, two and three detectors; the third lies around RA 0, and its middle detector is rendered."""
    corners = [(10, 0), (10, 0), (11, 0), (359, -40), (0, -40), (0, -39)]
    columns = {name: rows_of(TASKS, 6)[name] for name in TASKS.names}
    columns |= {"exposure_id": [1, 2, 2, 3, 3, 3], "radius": [0.8] * 6, "detector": ["a", "a", "b", "a", "b", "c"]}
    columns |= {"ra": [c[0] + 0.5 for c in corners], "dec": [c[1] + 0.5 for c in corners]}
    columns |= {"s_region": [square(*corner) for corner in corners], "channel": ["VIS"] * 6}
    exposures = {name: rows_of(EXPOSURES, 3)[name] for name in EXPOSURES.names} | {
        "exposure_id": [1, 2, 3],
        "channel": ["VIS"] * 3,
        "band": ["r", "i", "i"],
        "camera": ["vis"] * 3,
        "mjd": [60000.0, 60001.0, 60002.0],
    }
    done = PRODUCTS.build({
        "path": ["images/x.fits", "images/y.fits"], "content": ["science", "noise_free"], "exposure_id": [3, 3],
        "detector": ["b", "b"], "channel": ["VIS"] * 2, "band": ["i"] * 2, "ra": [0.5] * 2, "dec": [-39.5] * 2,
        "mission": ["m"] * 2, "sources": [0] * 2, "s_region": [square(0, -40)] * 2,
    })  # fmt: skip
    root = tmp_path_factory.mktemp("planned") / "lake"
    root.mkdir()
    for table, rows in ((TASKS, TASKS.build(columns)), (EXPOSURES, EXPOSURES.build(exposures))):
        publish.make_version(
            root, Plan(table, {}, (Task("0.parquet", {}),)), lambda lake, facts, rows=rows: Output(rows)
        )
    files = {path: lambda to: to.write_bytes(b"x") for path in done["path"].to_pylist()}
    publish.make_version(root, Plan(PRODUCTS, {}, (Task("0.parquet", {}),)), lambda lake, facts: Output(done, files))
    with serving(root) as page:
        yield page


def test_detectors(planned):
    found = {(one["exposure_id"], one["detector"]): one for one in planned.json("regions")}
    assert len(found) == 6
    assert {place for place, one in found.items() if one["state"] != "planned"} == {(3, "b")}
    assert (found[3, "b"]["images"], found[3, "b"]["contents"]) == ([0, 1], ["science", "noise_free"])
    assert [found[place]["band"] for place in ((1, "a"), (2, "b"), (3, "b"))] == ["r", "i", "i"]


def test_exposures_are_the_hulls_of_their_detectors(planned):
    one, two, three = planned.json("exposures")
    assert [e["exposure_id"] for e in (one, two, three)] == [1, 2, 3]
    assert [(e["state"], e["done"], e["failed"], e["all"]) for e in (one, two, three)] == [
        ("planned", 0, 0, 1), ("planned", 0, 0, 2), ("partly", 1, 0, 3),
    ]  # fmt: skip
    assert [(e["band"], e["camera"], e["mjd"], e["channel"]) for e in (one, three)] == [
        ("r", "vis", 60000.0, "VIS"), ("i", "vis", 60002.0, "VIS"),
    ]  # fmt: skip
    corners = {tuple(corner) for corner in two["outline"][0]}
    assert {(10, 0), (12, 0), (12, 1), (10, 1)} <= corners <= {(10, 0), (11, 0), (12, 0), (12, 1), (11, 1), (10, 1)}
    # About RA 0: the inner corner (0, -39) of the three squares is one no more.
    corners = {(ra % 360, dec) for ra, dec in three["outline"][0]}
    assert {(359, -40), (1, -40), (1, -38), (0, -38), (359, -39)} <= corners
    assert (0, -39) not in corners


def test_outlines_run_counter_clockwise_on_the_sky(planned):
    for exposure in planned.json("exposures"):
        ra, dec = np.array(exposure["outline"][0]).T
        # East is to the left.
        x, y = -((ra + 180) % 360 - 180), dec
        assert np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 0


def test_exposures_of_a_part(planned):
    def of(ra, dec, radius):
        return [one["exposure_id"] for one in planned.json(f"exposures?ra={ra}&dec={dec}&radius={radius}")]

    assert of(10.5, 0.5, 0.1) == [1, 2]
    assert of(13.5, 0.5, 0.3) == []
    assert of(0.0, -39.5, 0.1) == [3]
    assert of(180.0, 39.5, 0.1) == []


def test_too_many_exposures_are_refused(planned, monkeypatch):
    monkeypatch.setattr(sky_maps, "MAX_EXPOSURES", 2)
    status, _, body = planned.of_lake("exposures")
    assert (status, b"use a smaller field" in body) == (400, True)
    assert len(planned.json("exposures?ra=10.5&dec=0.5&radius=0.1")) == 2


def test_coverage(planned):
    """Each cell counts the exposures of two adjacent detectors, one of which is exposed twice."""
    assert planned.json("bands") == ["i", "r"]
    here = "&ra=11&dec=0.5&radius=2"
    area = {}
    for words in (here, f"{here}&band=i", f"{here}&band=r", "&ra=10.5&dec=0.5&radius=0.2"):
        _, _, body = planned.of_lake(f"coverage?order=9{words}")
        head, rest = unpacked(body)
        seen = np.frombuffer(rest, "<f4", head["cells"], 32 * head["cells"])
        area[words] = [float((seen == n).sum() * sky.cell_area(9)) for n in (1, 2, 3)]
    # To the width of the cells along the edges.
    assert area[here] == pytest.approx([1.0, 1.0, 0.0], abs=0.11)
    assert area[f"{here}&band=i"] == pytest.approx([2.0, 0.0, 0.0], abs=0.21)
    assert area[f"{here}&band=r"] == pytest.approx([1.0, 0.0, 0.0], abs=0.11)
    assert area["&ra=10.5&dec=0.5&radius=0.2"][1] > 0.1
    _, _, body = planned.of_lake("coverage?order=8")
    head, rest = unpacked(body)
    seen = np.frombuffer(rest, "<f4", head["cells"], 32 * head["cells"])
    assert set(seen) == {1.0, 2.0}


@pytest.mark.parametrize(
    ("corners", "wanted"),
    [
        ([(10, 0), (11, 0), (11, 1), (10, 1), (10.5, 0.5)], [(10, 0), (11, 0), (11, 1), (10, 1)]),
        ([(10, 0), (12, 0), (11, 0)], [(10, 0), (12, 0)]),
        ([(10, 5), (10, 7)], [(10, 5), (10, 7)]),
        ([(10, 5)], [(10, 5)]),
        ([(359, -80), (1, -80), (0, -79), (0, -80.005)], [(359, -80), (1, -80), (0, -79)]),
    ],
)
def test_hulls(corners, wanted):
    """Corners may lie on one line. The parallel at -80 deg is curved, so its points can be corners of the hull."""
    hull = sky_maps._convex_hull(np.array(corners, float))
    assert {tuple(corner) for corner in hull} >= set(wanted)
    assert (10.5, 0.5) not in {tuple(corner) for corner in hull}
    x, y = -((hull[:, 0] + 180) % 360 - 180), hull[:, 1]
    assert np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) >= 0
