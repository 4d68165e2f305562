"""The forecast of catalogues and fluxes: against what was measured, on the areas of its numbers and on another."""

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest

from lake_schema.store import layout, publish
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.fluxes import fluxes
from lake_schema.tables.galaxies import GALAXIES
from tests import requests
from tests.universe import rows_of
from truesky.catalogue import build_galaxies, build_stars
from truesky.fluxes import compute_fluxes
from truesky.render.forecasting import catalogue_forecast
from truesky.request.files import Catalogue, Ingest, UserSources
from truesky.request.from_toml import from_table

# Cone, limits and bands of three areas, and what their jobs made and took on an AMD EPYC whose calibration gave
# FACTOR: rows, CPU seconds (None = arrays of the machine's own were computed, too, or it was another machine), GB. The
# costs are of the first two.
AREAS = {
    "one": ((53.117, -27.808, 0.3), 26.0, 26.0, ["euclid_vis", "lsst_r"]),
    "two": ((270.0, 0.0, 0.25), 24.0, 24.0, ["euclid_vis"]),
    "three": ((150.1, 2.2, 0.6), 25.0, 22.0, ["euclid_vis", "lsst_r", "lsst_i"]),
}
MEASURED = {
    "one": {
        "build_galaxies": (466_693, None, 0.03994), "build_stars": (26_141, None, 0.00183),
        "compute_fluxes": (202_170, None, 0.06333),
    },
    "two": {
        "build_galaxies": (167_074, 9.67, 0.01199), "build_stars": (1_440_796, None, 0.09632),
        "compute_fluxes": (1_482_374, None, 0.08612),
    },
    "three": {
        "build_galaxies": (963_441, 13.82, 0.07282), "build_stars": (37_822, None, 0.00264),
        "compute_fluxes": (343_242, 3.83, 0.06829),
    },
}  # fmt: skip
FACTOR, ROWS_ERROR, SECONDS_ERROR, BYTES_ERROR = 0.45, 0.05, 0.3, 0.1


def request(cone, galaxies, stars, bands, **more):
    ra, dec, radius = cone
    return from_table(
        {
            "name": "x", "seed": 5, "area": {"cone": {"ra": ra, "dec": dec, "radius": radius}}, **more,
            "universe": {"galaxy_limit": galaxies, "star_limit": stars, "box_cells": 192, "lensing_nside": 256},
            "fluxes": {"bands": bands},
        }
    )  # fmt: skip


def forecast(wanted, factor=1.0):
    return {line.job: line for line in catalogue_forecast.for_request(wanted, factor)}


def test_more_is_dearer():
    one = forecast(request((53.0, -28.0, 0.3), 24.0, 22.0, ["euclid_vis"]))
    for change in (
        {"cone": (53.0, -28.0, 1.0)}, {"galaxies": 25.0, "stars": 24.0}, {"bands": ["euclid_vis", "lsst_r"]},
    ):  # fmt: skip
        given = {"cone": (53.0, -28.0, 0.3), "galaxies": 24.0, "stars": 22.0, "bands": ["euclid_vis"]}
        more = forecast(request(**{**given, **change}))
        assert all(more[job].seconds >= one[job].seconds and more[job].gb >= one[job].gb for job in one)
        assert more["compute_fluxes"].seconds > one["compute_fluxes"].seconds
    assert forecast(request((53.0, -28.0, 0.3), 24.0, 22.0, ["euclid_vis"]), 0.5)["build_stars"].seconds == (
        0.5 * one["build_stars"].seconds
    )


def test_stars_are_where_the_milky_way_is():
    high, low = (forecast(request(cone, 24.0, 24.0, ["euclid_vis"])) for cone in ((190, 27, 0.5), (270, 0, 0.5)))
    assert low["build_stars"].rows > 10 * high["build_stars"].rows


def test_the_numbers_are_a_forecast_of_another_area():
    """Measured on areas `one` and `two`, whose limits lie on both sides of the third's."""
    for area, found in MEASURED.items():
        lines = forecast(request(*AREAS[area]), FACTOR)
        for job, (rows, seconds, size) in found.items():
            assert lines[job].rows == pytest.approx(rows, rel=ROWS_ERROR), (area, job)
            if seconds is not None:
                assert lines[job].seconds == pytest.approx(seconds, rel=SECONDS_ERROR), (area, job)
            assert lines[job].gb == pytest.approx(size, rel=BYTES_ERROR), (area, job)


@pytest.fixture(scope="module")
def few_sources(tmp_path_factory):
    """A lake of few sources."""
    lake = tmp_path_factory.mktemp("lake")
    wanted = from_table(tomllib.loads(requests.text(
        f'fluxes.bands = ["euclid_vis"]\n{requests.shallow(22.0, 22.0)}', requests.FIELD.format(0.4)
    )))  # fmt: skip
    for job in (build_galaxies, build_stars, compute_fluxes):
        for step in job.steps(lake, wanted):
            publish.make_version(lake, step.plan, step.run_task)
    return lake, wanted


@pytest.mark.nightly
def test_what_is_drawn_is_what_was_forecast(few_sources):
    lake, wanted = few_sources
    held = {line.job: line for line in catalogue_forecast.for_lake(lake)}
    for job, line in forecast(wanted).items():
        assert (held[job].rows, held[job].gb) == pytest.approx((line.rows, line.gb), rel=1e-6)
        tables = {"build_galaxies": ["halos", "galaxies"], "build_stars": ["stars"]}.get(
            job, ["galaxy_fluxes", "star_fluxes"]
        )
        manifests = [json.loads((lake / name / "current" / "manifest.json").read_text()) for name in tables]
        assert sum(one["rows"] for one in manifests) == pytest.approx(line.rows, rel=0.25)


def test_requests_of_a_lake_add_up_and_what_they_share_is_made_once(lake):
    def made(table, facts, name):
        part = Task(layout.cell_file(5, 1607), {"generation_cells": [1607 << 6]})
        plan = Plan(table, facts, (part,))
        publish.make_version(lake, plan, lambda root, facts: Output(rows_of(table, 3)), name=name)
        return plan.key

    def lines():
        return {line.job: line for line in catalogue_forecast.for_lake(lake)}

    key = made(GALAXIES, {"galaxy_limit": 22.0}, "a")
    made(fluxes("galaxy", ["x"]), {"input": key, "bands": ["x"]}, "a")
    one = lines()
    made(fluxes("galaxy", ["y"]), {"input": key, "bands": ["y"]}, "b")
    two = lines()
    assert two["build_galaxies"] == one["build_galaxies"]
    assert two["compute_fluxes"].rows == 2 * one["compute_fluxes"].rows > 0.0
    assert two["compute_fluxes"].seconds == pytest.approx(2.0 * one["compute_fluxes"].seconds)
    made(GALAXIES, {"galaxy_limit": 22.5}, "b")
    assert lines()["build_galaxies"].rows > 2.0 * one["build_galaxies"].rows


def test_an_external_catalogue_is_not_forecast(tmp_path):
    (tmp_path / "g.csv").write_text("ra,dec\n0,0\n")
    wanted = request((53.0, -28.0, 0.3), 24.0, 22.0, ["euclid_vis"])
    given = Catalogue(files=(tmp_path / "g.csv",), format="csv", columns=())
    lines = forecast(replace(wanted, ingest=Ingest(galaxies=given)))
    assert list(lines) == ["build_stars", "compute_fluxes"]
    assert lines["compute_fluxes"].rows == lines["build_stars"].rows


def test_given_sources_are_as_many_as_their_tables_say(tmp_path):
    """Neither the depth of the sky nor halos count: a scene with a few rows has very small files."""
    (tmp_path / "g.csv").write_text("ra,dec,mag\n53,-28,20\n53,-28.01,21\n")
    (tmp_path / "s.csv").write_text("mag\n18\n")
    wanted = request((53.0, -28.0, 0.3), 24.0, 22.0, ["euclid_vis"])
    own = UserSources(tmp_path / "g.csv", None, "euclid_vis", 0.0)
    lines = forecast(replace(wanted, sources=own))
    assert {job: line.rows for job, line in lines.items()} == {"build_galaxies": 2, "compute_fluxes": 2}
    # Every 36 arcsec on a circle of 0.3 deg, two places in three a galaxy.
    (tmp_path / "g.csv").write_text("mag\n20\n21\n")
    lines = forecast(replace(wanted, sources=replace(own, stars=tmp_path / "s.csv", spacing=36.0)))
    assert lines["compute_fluxes"].rows == pytest.approx(np.pi * 30**2, rel=1e-3)
    assert lines["build_galaxies"].rows == pytest.approx(2 * lines["build_stars"].rows)


def test_stars_that_are_left_out_are_not_forecast(tmp_path):
    keys = (53.0, -28.0, 0.3), 24.0, 22.0, ["euclid_vis"]
    whole = request(*keys)
    faint = forecast(replace(whole, stars=replace(whole.stars, bright_limit=20.0)))["build_stars"].rows
    brighter = forecast(request(keys[0], 24.0, 20.0, keys[3]))["build_stars"].rows
    assert faint == pytest.approx(forecast(whole)["build_stars"].rows - brighter)
    assert brighter > 0
    own = replace(whole.stars, catalogue=tmp_path / "s.csv")
    assert list(forecast(replace(whole, stars=own))) == ["build_galaxies", "compute_fluxes"]
