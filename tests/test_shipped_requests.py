"""Run all jobs for every shipped request, reduced in area, depth, detectors and exposures.

test_field.py runs the demo request in full every day, and `test_checks.py` of the requests checks every request.
"""

import re
import tomllib
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from lake_schema.store import layout, read
from lake_schema.tables.exposures import RENDERED_TYPES
from truesky.catalogue import build_galaxies, build_stars
from truesky.commands import plan
from truesky.fluxes import compute_fluxes
from truesky.render import plan_exposures, render_exposures
from truesky.render.camera import detectors
from truesky.render.planning import ground_surveys, survey
from truesky.request.from_toml import from_table, parse
from truesky.running import submitted_job

REQUESTS = Path(__file__).parents[1] / "requests"
MODULES = (build_galaxies, build_stars, compute_fluxes, plan_exposures)
MISSION = resolve()


def middle(camera):
    """Return the detector nearest to the centre of a camera."""
    return min(detectors.detectors(camera, MISSION), key=lambda d: d.x**2 + d.y**2).name


def small(name):
    """Return a shipped request with one detector per camera, one field, one frame per type and bright sources."""
    table = tomllib.loads((REQUESTS / f"{name}.toml").read_text())
    table["accuracy"] = "draft"
    table["universe"] = {"galaxy_limit": 18.0, "star_limit": 14.0, "box_cells": 192, "lensing_nside": 64}
    for pointing in table.get("pointing", []):
        pointing["detectors"] = [middle(pointing.get("camera", pointing["channel"].lower()))]
    for block in table.get("observation", []):
        ground = "EXT" in block["channels"]
        camera = ground_surveys.camera_of(block["survey"], MISSION) if ground else "vis"
        if ground or "VIS" in block["channels"]:
            block["detectors"] = [middle(camera)]
        block |= {key: 1 for key in ("fields", "visits", "exposures") if key in block}
        if not ground and block.get("image_type", "science") in ("science", "deep"):
            block["dither"] = "none"
        # Blocks without coordinates keep the area of the request, so fields and calibrations keep their positions.
        if "ra" not in block:
            block.setdefault("area", table["area"])
    with pytest.raises(BadInput, match="this area is large enough") as refused:
        plan.check(from_table({**table, "area": {"cone": {"ra": 0.0, "dec": -60.0, "radius": 0.0}}}))
    table["area"] = tomllib.loads(re.search(r"this area is large enough: (.*)", str(refused.value))[1])["area"]
    return table


@pytest.mark.nightly
@pytest.mark.parametrize("name", [path.stem for path in sorted(REQUESTS.glob("*.toml"))])
def test_shipped_requests_run_through_all_jobs(name, tmp_path, monkeypatch):
    # Run the tasks in this process instead of in Spark workers.
    monkeypatch.setattr(submitted_job, "_spark_map", lambda function, parts, *rest: map(function, parts))
    request = from_table(small(name))
    plan.check(request)
    root = layout.resolve_lake(tmp_path / "lake")
    for module in MODULES:
        submitted_job.run(module.JOB, root, request)
    exposures = {row["exposure_id"]: row for row in read.version(root, "exposures").rows().to_pylist()}
    tasks = read.version(root, "tasks").rows(["exposure_id", "detector"]).to_pylist()
    # NISP exposures contain all detectors; rendering the central one is enough.
    some = {task["detector"] for task in tasks} & {middle(row["camera"]) for row in exposures.values()}
    submitted_job.run(render_exposures.JOB, root, replace(request, detectors=tuple(sorted(some))))
    is_rendered = {k for k, row in exposures.items() if row["image_type"] in RENDERED_TYPES.get(row["channel"], ())}
    rendered = {
        (task["exposure_id"], task["detector"])
        for task in tasks
        if task["exposure_id"] in is_rendered and task["detector"] in some
    }
    products = read.version(root, "products").rows(["exposure_id", "detector"]).to_pylist()
    assert rendered
    assert {number for number, _ in rendered} == is_rendered
    assert {(row["exposure_id"], row["detector"]) for row in products} == rendered


def test_the_pilot_observation_has_every_kind_of_image():
    """It has all image types except deep fields, which equal the wide survey, and all bands of ground surveys."""
    request = parse(REQUESTS / "pilot_one_observation.toml")
    found = [exposure for exposure, _ in survey.exposures(request, MISSION)]
    rendered = {(channel, kind) for channel, kinds in RENDERED_TYPES.items() for kind in kinds if kind != "deep"}
    assert {(one.channel, one.image_type) for one in found} == rendered
    euclid = [one for one in found if one.image_type == "science" and one.channel != "EXT"]
    assert Counter(one.channel for one in euclid) == {"VIS": 4, "NISP-P": 12, "NISP-S": 4}
    assert not any(one.detectors for one in euclid)
    ground = {one.band for one in found if one.channel == "EXT" and one.image_type == "science"}
    assert ground == {band for rule in MISSION.rows("survey.external") for band in rule["bands"].split()}
    assert len({one.camera for one in found if one.channel == "EXT"}) == 6
