"""Depth maps of a survey; each position of a detector counts once."""

import numpy as np
import pytest

from lake_schema import sky
from lake_schema.mission.configuration import resolve
from lake_schema.store import publish, read
from truesky.render import coverage, plan_exposures
from truesky.render.camera import astrometry, detectors, footprints
from truesky.render.plan_exposures import plan
from truesky.render.planning import planned_exposures, source_counts, tasks
from truesky.request import schema
from truesky.request.from_toml import from_table


@pytest.mark.parametrize("distortion", [0.0, 0.01])
def test_a_footprint_ends_where_the_detector_does(distortion):
    """Accurate to one pixel, or to three with distortion, since the sides of a footprint are straight."""
    mission = resolve(overrides={"vis.fpa.distortion": (distortion, "")})
    exposure = planned_exposures.Exposure(
        "VIS", "vis", "euclid_vis", "science", 10.0, 85.0, 33.0, 60905.0, 560.0, "x", sky=0.2
    )
    rows = tasks.table(
        planned_exposures.table([exposure], [mission]),
        [("2-5",)],
        mission,
        source_counts.Densities(mission, schema.Universe()),
    )
    detector = detectors.detector("vis", "2-5", mission)
    system = astrometry.wcs(detector, 10.0, 85.0, 33.0)
    x, y = np.random.default_rng(1).uniform(-500, 4600, (2, 3000))
    inside = (x > -0.5) & (x < detector.nx - 0.5) & (y > -0.5) & (y < detector.ny - 0.5)
    assert 0.3 < inside.mean() < 0.95
    sharp = np.ones(len(x), bool)
    if distortion:
        edges = np.abs([x + 0.5, x - detector.nx + 0.5, y + 0.5, y - detector.ny + 0.5])
        sharp = edges.min(axis=0) > 3.0
        assert 0.98 < sharp.mean() < 1.0
    found = footprints.counts(rows, *astrometry.sky_of_pixel(system, x, y))
    np.testing.assert_array_equal(found[sharp], inside[sharp])


@pytest.fixture(scope="module")
def dithers(tmp_path_factory):
    """Return, by channel, how often random positions in the interior of a request are observed in one band."""
    area = {"cone": {"ra": 150.0, "dec": 20.0, "radius": 1.4}}
    block = {"channels": ["VIS", "NISP-P"], "short": False, "flat": False}
    wanted = from_table({"name": "x", "seed": 7, "area": area, "observation": [block]})
    _, exposures, rows = plan(tmp_path_factory.mktemp("none"), wanted)
    seen = {row["exposure_id"] for row in exposures.to_pylist() if row["band"] in ("euclid_vis", "euclid_j")}
    assert len(seen) > 60
    rows = rows.filter([i in seen for i in rows["exposure_id"].to_pylist()])
    rng = np.random.default_rng(2)
    radius, angle = 0.7 * np.sqrt(rng.random(4000)), 2 * np.pi * rng.random(4000)
    ra, dec = 150.0 + radius * np.cos(angle) / np.cos(np.radians(20.0)), 20.0 + radius * np.sin(angle)
    assert sky.separation(ra, dec, 150.0, 20.0).max() < 0.72
    return {c: footprints.counts(rows.filter([x == c for x in rows["channel"].to_pylist()]), ra, dec)
            for c in ("VIS", "NISP-P")}  # fmt: skip


@pytest.mark.parametrize(("channel", "least"), [("VIS", 0.95), ("NISP-P", 0.88)])
def test_the_interior_is_seen_three_times(dithers, channel, least):
    """Scaramella et al. 2022: the dithers fill the gaps between the detectors."""
    assert (dithers[channel] >= 3).mean() >= least


def test_a_plan_is_mapped_from_the_lake(lake, capsys):
    """With four dithers, the centre is observed four times except in gaps; the map shows the measured values."""
    area = {"cone": {"ra": 150.0, "dec": 20.0, "radius": 0.5}}
    block = {"channels": ["VIS"], "fields": 1}
    wanted = from_table({"name": "x", "seed": 7, "area": area, "observation": [block]})
    for step in plan_exposures.steps(lake, wanted):
        publish.make_version(lake, step.plan, step.run_task)
    picture = lake / "coverage.png"
    assert coverage.main(["--lake", str(lake), "--out", str(picture)]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[-1] == str(picture)
    assert said[-2].startswith("VIS     euclid_vis        4 exposures   fraction of the interior >= 1: ")
    assert picture.read_bytes().startswith(b"\x89PNG")
    exposures, tasks = (read.version(lake, name) for name in ("exposures", "tasks"))
    assert coverage.area_of(exposures) == wanted.area
    (depth,) = coverage.depths(exposures.rows(), lambda: [tasks.rows()], wanted.area, side=120)
    assert depth.counts.max() == 4
    # The short exposure and the flat are not counted; outside the field the depth is 0.
    assert (depth.counts[0] == 0).all()
    middle = depth.counts[50:70, 50:70]
    # Half of the positions are in the gap between detectors once, few twice, and none four times.
    assert 0.3 < (middle == 4).mean() < 0.7
    assert (middle >= 3).mean() > 0.9
    assert (middle >= 1).all()
    assert coverage.main(["--lake", str(lake / "none")]) == 2
    assert "none does not exist; make it with truesky run" in capsys.readouterr().err
