"""All image types of VIS, made by the jobs from a request and its catalogues."""

import tomllib
from collections import Counter, defaultdict
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits

from lake_schema.errors import BadInput
from lake_schema.ids import kind_from_id
from lake_schema.sky.ecliptic import ecliptic
from lake_schema.store import layout, publish, read
from tests import requests
from truesky.catalogue import build_galaxies, build_stars
from truesky.fluxes import compute_fluxes
from truesky.render import plan_exposures, render_exposures
from truesky.render.camera import detectors
from truesky.render.products import read_back
from truesky.render.sources import solar_system
from truesky.request.from_toml import from_table
from truesky.running import submitted_job

MODULES = (build_galaxies, build_stars, compute_fluxes, plan_exposures, render_exposures)
BLOCK = {"channels": ["VIS"], "detectors": ["3-4"]}
SHORT = 89.52
# Range of the median, in electrons above the bias.
KINDS = {
    "science": (100, 250), "bias": (-4, 4), "dark": (-4, 4), "flat": (11_000, 21_000), "charge_injection": (-4, 4),
    "self_calibration": (100, 250),
}  # fmt: skip

DARK = ("bias", "dark", "charge_injection")


def wanted():
    """Return a request for a visit with short exposure and closing flat, and one frame of each calibration type."""
    blocks = [{**BLOCK, "fields": 1, "dither": "none"}]
    for kind in list(KINDS)[1:]:
        blocks.append({**BLOCK, "image_type": kind, "exposures": 1})
        if kind == "dark":
            blocks[-1]["exposure_time_s"] = 600.0
        elif kind == "flat":
            blocks[-1]["lamps"] = [1]
    universe = requests.shallow(17.0, 12.0, 'lensing = "none"\n')
    keys = f'accuracy = "draft"\n{universe}[fluxes]\nbands = ["euclid_vis"]\n'
    table = tomllib.loads(requests.text(keys, requests.FIELD.format(0.2), seed=7))
    return from_table({**table, "observation": blocks, "products": {"truth": ["saturation"]}})


@contextmanager
def small_detectors(side=256):
    """Detectors of VIS cut to their centres: two halves and the gap."""
    mounted = detectors._apply_metrology

    def smaller(*args):
        for d in mounted(*args):
            yield replace(d, nx=side, ny=side + d.injection_rows)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(detectors, "_apply_metrology", smaller)
        yield


def check(lake, rows, columns):
    """Check that every requested frame has its type and the size of the quadrants."""
    exposures = exposures_of(lake)
    products = read.version(lake, "products")
    science = [row for row in products.rows().to_pylist() if row["content"] == "science"]
    assert len(science) == len(exposures)
    found = set()
    for row in science:
        exposed = exposures[row["exposure_id"]]
        kind = exposed["image_type"]
        path = products.sidecar_path(row["path"])
        with fits.open(path) as units:
            header = units[0].header
            assert header["IMAGETYP"] == kind
            assert header["EXPTIME"] == pytest.approx(exposed["exposure_time_s"])
            assert header.get("LAMP") == exposed["lamp"]
            assert [unit.shape for unit in units[1:]] == [(rows, columns)] * 4
        least, most = KINDS[kind] if exposed["exposure_time_s"] != SHORT else (10, 40)
        assert least < np.median(read_back.electrons(path).data) < most
        found.add((kind, round(exposed["exposure_time_s"])))
    assert found == {
        ("science", 561), ("science", 90), ("flat", 10), ("bias", 0), ("dark", 600), ("charge_injection", 0),
        ("self_calibration", 561),
    }  # fmt: skip


def one_body_each(lake, file, mag):
    """Return a table with one moving body per day at the centre of each frame of the sky."""
    rows = [row for row in exposures_of(lake).values() if row["image_type"] not in DARK]
    tasks = {row["exposure_id"]: row for row in read.version(lake, "tasks").rows().to_pylist()}
    lines = ["mjd,lon,lat,east,north,mag,name"]
    for row in rows:
        lon, lat = ecliptic(*(tasks[row["exposure_id"]][axis] for axis in ("ra", "dec")))
        lines.append(f"{row['mjd']},{lon},{lat},0,0,{mag},{row['exposure_id']}")
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file


def exposures_of(lake):
    return {row["exposure_id"]: row for row in read.version(lake, "exposures").rows().to_pylist()}


def moving_of(lake):
    """Return the number of bodies drawn, by image type."""
    exposures, found = exposures_of(lake), defaultdict(set)
    drawn = read.version(lake, "rendered_truth").rows(["exposure_id", "id"])
    count = Counter(drawn["exposure_id"].to_numpy()[kind_from_id(drawn["id"].to_numpy()) == solar_system.KIND].tolist())
    for number, row in exposures.items():
        found[row["image_type"]].add(count[number])
    return found


def check_bodies(lake, request):
    """The bodies of the table are drawn on frames of the sky; other frames do not depend on the table."""
    seen = moving_of(lake)
    for kind in KINDS:
        assert (min(seen[kind]) > 0) == (max(seen[kind]) > 0) == (kind not in DARK)
    step = render_exposures.steps(lake, request)[0]
    exposures = exposures_of(lake)
    before = {part.facts["exposure_id"]: part for part in step.plan.tasks}
    one_body_each(lake, request.bodies, 17.0)
    after = {part.facts["exposure_id"]: part for part in render_exposures.steps(lake, request)[0].plan.tasks}
    same = {number for number in before if before[number].facts["product"] == after[number].facts["product"]}
    assert same == {number for number, row in exposures.items() if row["image_type"] in DARK}
    for number, part in before.items():
        facts = {**step.plan.facts, **part.facts}
        if exposures[number]["image_type"] == "bias":
            assert render_exposures.render_task(lake, facts).rows.num_rows
        elif number not in same:
            with pytest.raises(BadInput, match=r"bodies\.csv: has changed since the rendering began"):
                render_exposures.render_task(lake, facts)


def test_each_kind_is_planned_rendered_and_published(lake, tmp_path):
    request = wanted()
    with small_detectors():
        for job in MODULES:
            if job is render_exposures:
                request = replace(request, bodies=one_body_each(lake, tmp_path / "bodies.csv", 18.0))
            for step in job.steps(lake, request):
                publish.make_version(lake, step.plan, step.run_task)
        check(lake, 128 + 20, 51 + 128 + 29)
        check_bodies(lake, request)


@pytest.mark.nightly
def test_by_spark_whole_detectors(spark, tmp_path):
    root = layout.resolve_lake(tmp_path / "lake")
    for module in MODULES:
        submitted_job.run(module.JOB, root, wanted())
    check(root, 2086, 2128)
