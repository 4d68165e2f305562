"""The benchmark of images of single places."""

import json

import pytest

from lake_schema.store import publish
from tests.benchmarks import run
from truesky.catalogue import build_galaxies, build_stars
from truesky.fluxes import compute_fluxes
from truesky.render import plan_exposures, render_exposures
from truesky.request.from_toml import from_table

# The two detectors of the demo request, with few sources.
REQUEST = {
    "name": "few",
    "seed": 1,
    "area": {"cone": {"ra": 53.117, "dec": -27.808, "radius": 0.2}},
    "universe": {"galaxy_limit": 20.0, "star_limit": 18.0, "box_cells": 192, "lensing_nside": 64},
    "pointing": [
        {
            "channel": channel, "camera": camera, "band": band, "ra": 53.117, "dec": -27.808, "centre_on": detector,
            "detectors": [detector], "mjd": 60905.0,
        }
        for channel, camera, band, detector in (
            ("VIS", "vis", "euclid_vis", "3-4"), ("EXT", "lsstcam", "lsst_r", "R22_S11"),
        )
    ],
    "products": {"truth": ["noise_free"]},
}  # fmt: skip


@pytest.mark.nightly
def test_the_benchmark(tmp_path):
    request, lake, file = from_table(REQUEST), tmp_path / "lake", tmp_path / "stamps.json"
    lake.mkdir()
    for module in (build_galaxies, build_stars, compute_fluxes, plan_exposures, render_exposures):
        for step in module.steps(lake, request):
            publish.make_version(lake, step.plan, step.run_task)
    run("stamps", "--quick", "--lake", lake, "--json", file)
    figures = json.loads(file.read_text())
    assert figures["frame_differences"] == 0
    assert figures["largest_difference"] < 1.0 / 320.0
    assert figures["import_s"] < figures["first_s"]
