"""Actual costs of detectors and their forecast, by kind of exposure and per area of the sky."""

import json

import numpy as np
import pytest

from lake_schema.store import layout, publish
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.exposures import EXPOSURES
from lake_schema.tables.products import PRODUCTS
from lake_schema.tables.tasks import TASKS
from tests.universe import rows_of
from truesky.render.forecasting import actual_costs
from truesky.render.forecasting.image_costs import size_ratio

# Exposure, channel and image type. Detectors have 0.2 x 0.2 deg: two adjacent ones, each exposed twice, and a bias.
FRAMES = ((0, "VIS", "science"), (1, "VIS", "science"), (2, "VIS", "bias"), (3, "EXT", "science"))
PLACES = {"a": 10.0, "b": 10.2}


def square(ra, half=0.1):
    corners = [(ra + x, y) for x, y in ((-half, -half), (half, -half), (half, half), (-half, half))]
    return "POLYGON ICRS " + " ".join(f"{value:.6f}" for corner in corners for value in corner)


def published(lake, table, rows):
    """Key of a version of a table with these columns, the others whatever is legal."""
    legal = rows_of(table, len(rows["exposure_id"]))
    columns = {name: rows.get(name, legal[name]) for name in table.names}
    plan = Plan(table, {}, (Task("all.parquet", {}),))
    publish.make_version(lake, plan, lambda root, own: Output(table.build(columns)))
    return plan.key


@pytest.fixture
def rendered(lake):
    return made(lake, "none")


def made(lake, compression):
    """A lake with all but one detector made, all but one of which a log tells of."""
    planned = [(number, name, channel) for number, channel, _ in FRAMES for name in PLACES]
    tasks = published(
        lake,
        TASKS,
        {
            "exposure_id": [number for number, *_ in planned], "detector": [name for _, name, _ in planned],
            "channel": [channel for *_, channel in planned], "ra": [PLACES[name] for _, name, _ in planned],
            "dec": [0.0] * len(planned), "radius": [0.15] * len(planned),
            "s_region": [square(PLACES[name]) for _, name, _ in planned],
            "seconds": [10.0] * len(planned), "bytes": [10**6] * len(planned),
        },
    )  # fmt: skip
    exposures = published(
        lake,
        EXPOSURES,
        {
            "exposure_id": [n for n, *_ in FRAMES], "channel": [c for _, c, _ in FRAMES],
            "image_type": [t for *_, t in FRAMES], "camera": ["vis", "vis", "vis", "hsc"],
        },
    )  # fmt: skip
    present = planned[:-1]
    parts = [Task(f"{i}.parquet", {"exposure_id": n, "detector": d}) for i, (n, d, _) in enumerate(present)]
    facts = {
        "inputs": {"tasks": tasks, "exposures": exposures},
        "request": {"compression": compression, "readout": "raw", "truth": ["noise_free"]},
    }
    plan = Plan(PRODUCTS, facts, tuple(parts))
    publish.make_version(lake, plan, lambda root, facts: Output(PRODUCTS.empty()))
    lines = [{"job": "render_exposures", "table": "products", "key": plan.key}]
    lines += [{"part": part.name, "cpu_s": 5.0 + i, "peak_gb": 1.0 + i} for i, part in enumerate(parts[:-1])]
    (folder := layout.runs_folder(lake)).mkdir(exist_ok=True)
    text = "".join(json.dumps(line) + "\n" for line in [*lines, {"part": parts[-1].name, "error": "no"}])
    (folder / "1-products-1.jsonl").write_text(text)
    return lake


def test_lines_of_a_request(rendered):
    lines = {(one.channel, one.image_type): one for one in actual_costs.summarise(rendered, factor=2.0)}
    science, bias, ground, vis, total = (
        lines[key] for key in (("VIS", "science"), ("VIS", "bias"), ("EXT", "science"), ("VIS", ""), ("all", ""))
    )
    assert (science.planned, science.rendered, science.measured) == (4, 4, 4)
    assert (science.cpu_s, science.forecast_s, science.peak_gb) == (5.0 + 6 + 7 + 8, 80.0, 4.0)
    assert science.forecast_gb == pytest.approx(4e-3)
    # Each place once, though two exposures see it.
    assert science.deg2 == pytest.approx(0.08, rel=0.02)
    assert science.core_hours_deg2 == pytest.approx(26.0 / 3600.0 / 0.08, rel=0.02)
    assert (bias.measured, bias.deg2, bias.core_hours_deg2) == (2, 0.0, 0.0)
    assert (ground.planned, ground.rendered, ground.measured, ground.core_hours_deg2) == (2, 1, 0, 0.0)
    assert (vis.cpu_s, vis.core_hours_deg2) == (26.0 + 9.0 + 10.0, science.core_hours_deg2)
    assert (total.planned, total.rendered, total.measured, total.peak_gb) == (8, 7, 6, 6.0)
    assert total.core_hours_deg2 == science.core_hours_deg2


def test_the_forecast_of_sizes_includes_compression(lake):
    """A VIS image and its noise-free image become smaller, by the measured ratios."""
    lines = actual_costs.summarise(made(lake, "rice"))
    (vis,) = (line for line in lines if (line.channel, line.image_type) == ("VIS", "science"))
    assert vis.forecast_gb == pytest.approx(4e-3 * size_ratio("VIS", "science", "rice", "raw", ["noise_free"]))
    assert 1e-3 < vis.forecast_gb < 3.5e-3


def test_the_table(rendered):
    head, *lines = actual_costs.format_table(actual_costs.summarise(rendered))
    assert {len(line) for line in lines} == {len(head)}
    assert np.isclose(float(lines[2].split()[-1]), 26.0 / 3600.0 / 0.08, atol=0.003)
    assert lines[1].split()[-2:] == ["-", "-"]
