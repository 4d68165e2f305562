"""A lake of two requests, whose exposure numbers are independent and must not be mixed up."""

import json

import numpy as np
import pytest

from lake_schema.store import layout, publish
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.exposures import EXPOSURES
from lake_schema.tables.passbands import PASSBANDS
from lake_schema.tables.tasks import TASKS
from tests.truesky.page import test_traces
from tests.truesky.page.conftest import CENTRE, serving, unpacked
from tests.universe import plain_plan, plain_work, rows_of
from truesky.page.lake_session import LakeSession
from truesky.page.tap import images

# For each request: band, right ascension of the second exposure, MJD of the first exposure, first pixel of the trace,
# and ends of the passband (angstrom).
REQUESTS = {
    "a": ("nisp_red", CENTRE[0] + 1.0, 60000.0, 80.0, (12000.0, 18000.0)),
    "b": ("nisp_blue", CENTRE[0] + 5.0, 61000.0, 95.0, (9000.0, 13000.0)),
}


def square(ra, dec, half):
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    return "POLYGON ICRS " + " ".join(f"{ra + x:.7f} {dec + y:.7f}" for x, y in corners)


def planned(root, name):
    """Publish the plan of a request: exposure 7, which has been rendered, and exposure 8, which has not."""
    band, ra, mjd, _, ends = REQUESTS[name]
    rows, dec = rows_of(EXPOSURES, 2), CENTRE[1]
    exposures = {column: rows[column] for column in EXPOSURES.names} | {
        "exposure_id": [7, 8], "channel": ["NISP-S"] * 2, "camera": ["nisp"] * 2, "band": [band] * 2,
        "image_type": ["science"] * 2, "ra": [CENTRE[0], ra], "dec": [dec, dec], "position_angle": [0.0, 0.0],
        "mjd": [mjd, mjd + 1.0], "exposure_time_s": [500.0, 500.0], "grism_angle": [0.0, 0.0],
    }  # fmt: skip
    rows = rows_of(TASKS, 2)
    tasks = {column: rows[column] for column in TASKS.names} | {
        "exposure_id": [7, 8], "detector": ["DET22"] * 2, "channel": ["NISP-S"] * 2, "ra": [CENTRE[0], ra],
        "dec": [dec, dec], "radius": [0.2, 0.2], "s_region": [square(CENTRE[0], dec, 0.1), square(ra, dec, 0.1)],
    }  # fmt: skip
    rows = rows_of(PASSBANDS, 1)
    curve = {column: rows[column] for column in PASSBANDS.names} | {
        "name": ["nisp_red" if name == "a" else "nisp_blue"], "first_wavelength": [ends[0]],
        "wavelength_step": [(ends[1] - ends[0]) / 10.0], "response": [[1.0] * 11],
    }  # fmt: skip
    for table, columns in ((EXPOSURES, exposures), (TASKS, tasks), (PASSBANDS, curve)):
        plan = Plan(table, {"made_by": name}, (Task("0.parquet", {}),))
        own = table.build(columns)
        publish.make_version(root, plan, lambda lake, facts, own=own: Output(own), name=name)


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """Serve a lake of three requests: exposure 8 of the first failed, and the third shares the tables of the second."""
    root = tmp_path_factory.mktemp("two") / "lake"
    root.mkdir()
    for seconds, name in enumerate(("a", "b", "c"), start=1):
        own = "b" if name == "c" else name
        band, *_, first, _ = REQUESTS[own]
        identifier, _ = test_traces.published(root, [first, *test_traces.TRACE_X[1:]], name, band, min(seconds, 2))
        if name != "c":
            planned(root, name)
    # The third request also shares the plan.
    for table in ("exposures", "tasks", "passbands"):
        target = layout.request_link(root, "b", table).readlink()
        layout.request_link(root, "c", table).symlink_to(target)
    log = layout.runs_folder(root) / "20260101-products-1.jsonl"
    log.parent.mkdir(exist_ok=True)
    lines = [
        {"job": "render_exposures", "request": "a", "table": "products"},
        {"part": "000008-det22.parquet", "error": "no memory", "attempt": 1, "seconds": 1.0, "peak_gb": 1.0},
        {"status": "failed", "seconds": 2.0},
    ]
    log.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    with serving(root) as page:
        yield page, identifier


def by_request(found):
    return {(one["request"], one["exposure_id"]): one for one in found}


def test_requests_that_share_everything_count_once(two):
    page, _ = two
    assert [(one.request, one.names) for one in page.server.lake.observed_requests] == [
        ("a", ("a",)),
        ("b", ("b", "c")),
    ]
    (galaxies,) = page.server.lake.request_tables("galaxies")
    assert (galaxies.request, galaxies.names) == (None, ("a", "b", "c"))
    assert page.server.lake.request_tables("stars") == []


def test_one_request_is_not_named(two):
    page, _ = two
    lake = LakeSession(page.server.lake.root, "b")
    try:
        assert [(one.request, one.names) for one in lake.observed_requests] == [(None, ("b",))]
        assert lake.observed_requests[0].rows("tasks", ["exposure_id"]) == [{"exposure_id": 7}, {"exposure_id": 8}]
    finally:
        lake.close()


def test_tables_without_a_request_belong_to_every_request(tmp_path):
    root = tmp_path / "lake"
    root.mkdir()
    test_traces.published(root)
    publish.make_version(root, plain_plan(), plain_work, name="new")
    lake = LakeSession(root)
    try:
        assert [one.names for one in lake.observed_requests] == [("new",)]
        assert len(lake.observed_requests[0].rows("products")) == 1
    finally:
        lake.close()


def test_footprints(two):
    page, _ = two
    found = by_request(page.json("regions"))
    assert {place: one["state"] for place, one in found.items()} == {
        ("a", 7): "observed", ("a", 8): "failed", ("b", 7): "observed", ("b", 8): "planned",
    }  # fmt: skip
    assert [found[name, 7]["images"] for name in "ab"] == [[0], [1]]
    for name, (band, ra, *_) in REQUESTS.items():
        assert found[name, 7]["band"] == found[name, 8]["band"] == band
        assert np.mean([corner[0] for corner in found[name, 8]["polygon"]]) == pytest.approx(ra)
    found = by_request(page.json("exposures"))
    assert len(found) == 4
    for name, (band, ra, mjd, *_) in REQUESTS.items():
        assert (found[name, 7]["band"], found[name, 7]["mjd"], found[name, 7]["all"]) == (band, mjd, 1)
        assert np.mean([corner[0] for corner in found[name, 8]["outline"][0]]) == pytest.approx(ra)


def test_depth_in_a_band(two):
    page, _ = two
    for band, ra, *_ in REQUESTS.values():
        head, rest = unpacked(page.of_lake(f"coverage?order=9&band={band}")[2])
        corners = np.frombuffer(rest, "<f4", 8 * head["cells"]).reshape(-1, 4, 2)
        assert corners[..., 0].max() == pytest.approx(ra, abs=0.4)
        assert head["rows"] == 2


def test_images_and_what_was_done(two):
    page, _ = two
    assert [(one["request"], one["band"]) for one in page.json("images")] == [("a", "nisp_red"), ("b", "nisp_blue")]
    assert [page.json(f"image/{number}")["request"] for number in (0, 1)] == ["a", "b"]
    found = page.json("runs")
    assert [(one["request"], one["done"], one["all"]) for one in found["tasks"]] == [("a", 1, 2), ("b", 1, 2)]
    assert [(one["request"], one["error"]) for one in found["failures"]] == [("a", "no memory")]


def test_traces_lie_on_the_images_of_their_request(two):
    page, identifier = two
    spectra = [one for one in page.json(f"source/{identifier}")["spectra"] if one["order"] == 1]
    assert [(one["request"], one["band"], one["images"], one["trace_x"][0]) for one in spectra] == [
        (name, REQUESTS[name][0], {"science": number}, REQUESTS[name][3]) for number, name in enumerate("ab")
    ]
    # Both images have their light on the trace of the first request, so only this trace contains light.
    pixels = []
    for number in (0, 1):
        head, rest = unpacked(page.of_lake(f"trace/{number}/{identifier}?order=1")[2])
        pixels.append(np.frombuffer(rest, "<f4").reshape(head["rows"], head["columns"])[head["rows"] // 2])
    assert np.mean(pixels[0] >= test_traces.LEVEL) > 0.95
    assert np.mean(pixels[1] >= test_traces.LEVEL) < 0.5


def test_images_as_obscore_describes_them(two):
    page, _ = two
    rows = images.obscore_rows(page.server.lake, "http://here")
    assert [(row["obs_id"], row["t_min"]) for row in rows] == [("a/7", 60000.0), ("b/7", 61000.0)]
    assert [(row["em_min"] * 1e10, row["em_max"] * 1e10) for row in rows] == [
        pytest.approx(REQUESTS[name][-1]) for name in "ab"
    ]
