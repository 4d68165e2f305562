"""The check refuses every request that a job would refuse: the shipped requests with one change each, 60 in total."""

import copy
import math
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from lake_schema.errors import BadInput
from truesky.api import simulate
from truesky.catalogue import build_galaxies, build_stars
from truesky.commands import check
from truesky.render import plan_exposures
from truesky.request.from_toml import from_table, read_valid_parts
from truesky.running import submitted_job

REQUESTS = Path(__file__).resolve().parents[3] / "requests"
# The plans of the others have 1e5 detectors and more.
FILES = (
    "demo", "field", "nisp_calibration", "nisp_spectra", "slitless", "vis_calibration", "demo", "field", "slitless",
    "pilot_one_observation",
)  # fmt: skip
# Changes of one value, by the kind of the value.
NUMBERS = (0, -1, 1e6, math.nan, math.inf, "1", True, 0.001, 30, [1.0])
TEXTS = ("", "x", 3, "../x", "VIS", "EXT", "NISP-S", "lsst_r", "euclid_h", ["x"])
LISTS = ([], ["x"], "x", 3)
# Keys that are added, at the top or in the first exposures: at their limits, beyond them, or in a wrong place.
ADDED = (
    ("universe", "galaxy_limit", 10.0), ("universe", "galaxy_limit", 30.0), ("universe", "z_max", 0.01),
    ("universe", "lensing", {"g1": 0.9, "g2": 0.0}), ("universe", "lensing", {"g1": 0.7, "g2": 0.7}),
    ("universe", "galaxy_band", "lsst_r"), ("universe", "galaxy_band", "sdss_r01"), ("stars", "bright_limit", 29.0),
    ("stars", "plane_limit", 0.0), ("stars", "rows_a_file", 1), ("effects", "off", ["all"]),
    ("effects", "off", ["adc"]),
    ("effects", "on", ["persistence"]), ("fluxes", "bands", ["gaia_g"]), ("fluxes", "bands", ["r"]),
    ("psf", "euclid_vis", "none.fits"), ("psf", "nisp_red", "none.fits"), ("psf", "lsst_u", "none.fits"),
    ("mission", "overrides", {"vis.gain": {"value": 1000.0, "unit": "electron / adu"}}),
    ("mission", "overrides", {"vis.read_noise": {"value": 0.0, "unit": "electron"}}),
    ("mission", "overrides", {"nisp.macc.photometric.groups": {"value": 900.0, "unit": ""}}),
    ("mission", "overrides", {"vis.fpa.nx": {"value": 4097.0, "unit": "pix"}}),
    ("mission", "ladder", ["REQ"]), ("strong_lenses", "boost", 1e5), ("structure", "arms", True),
    ("structure", "stamps", {"file": "none.fits"}), ("products", "truth", ["ramp", "traps", "order_1"]),
    ("products", "files", "exposure"), ("explore", "vis.gain", {"values": [1.0, 2.0], "unit": "electron / adu"}),
    ("explore", "effects.poisson", [True, False]), ("explore", "effects.adc", [False]),
    ("ingest", "galaxies", {"files": ["none.parquet"], "format": "flagship2"}), ("solar_system", "bodies", "none.csv"),
)  # fmt: skip


def leaves(value, path=()):
    """Yield the paths of all values of a request that are no tables."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from leaves(item, (*path, key))
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for i, item in enumerate(value):
            yield from leaves(item, (*path, i))
    else:
        yield path, value


def mutated(stem, number):
    """Return a shipped request with one change, and a description. The change depends only on the arguments."""
    table = tomllib.loads((REQUESTS / f"{stem}.toml").read_text(encoding="utf-8"))
    table = copy.deepcopy(table)
    if number % 2 == 0:
        section, key, value = ADDED[number // 2]
        table.setdefault(section, {})[key] = value
        return table, f"{section}.{key} = {value}"
    values = [leaf for leaf in leaves(table) if leaf[0][0] != "name"]
    path, old = values[11 * (number // 2) % len(values)]
    parent = table
    for part in path[:-1]:
        parent = parent[part]
    if number % 10 == 1:
        del parent[path[-1]]
        return table, f"no {path}"
    new_values = LISTS if isinstance(old, list) else TEXTS if isinstance(old, str) else NUMBERS
    parent[path[-1]] = new_values[number // 3 % len(new_values)]
    return table, f"{path} = {parent[path[-1]]!r}"


CHANGED = [(stem, number) for number, stem in enumerate(FILES * 6)]
# A few that are quick to plan run by default.
SAMPLE = [pytest.param(*case, marks=[] if case[1] in (1, 10) else [pytest.mark.nightly]) for case in CHANGED]


def problem_of_check(table):
    try:
        check.checked_request(read_valid_parts(table, REQUESTS))
    except BadInput as error:
        return str(error)
    return ""


def problem_of_jobs(table, lake):
    """Return the first problem for which a job refuses a request before it makes a table, "" if there is none."""
    try:
        request = from_table(table, REQUESTS)
        # The galaxies' job computes the matter of the universe before it makes a table: a small box is enough here.
        universe = replace(request.universe, box_cells=192, lensing_nside=64)
        request = replace(request, seed=1, universe=universe)
        for job in (build_galaxies.JOB, build_stars.JOB, plan_exposures.JOB):
            job.steps(lake, request)
    except BadInput as error:
        return str(error)
    return ""


def test_there_are_60_different_requests():
    assert len({repr(mutated(*case)) for case in CHANGED}) == len(CHANGED) == 60


@pytest.mark.parametrize(("stem", "number"), SAMPLE)
def test_what_a_job_refuses_is_refused_by_the_check(stem, number, tmp_path):
    table, change = mutated(stem, number)
    refused_by_check, refused_by_job = problem_of_check(table), problem_of_jobs(table, tmp_path)
    assert bool(refused_by_check) >= bool(refused_by_job), f"{change}: {refused_by_job}"


@pytest.mark.nightly
@pytest.mark.parametrize(("stem", "number"), CHANGED)
def test_what_the_check_accepts_runs_to_the_end(stem, number, tmp_path, monkeypatch):
    """One detector is rendered, of a universe with few sources, in this process."""
    monkeypatch.setattr(submitted_job, "_spark_map", lambda run_task, tasks, *_: [run_task(task) for task in tasks])
    monkeypatch.setattr(submitted_job, "has_session", lambda: True)
    table, _ = mutated(stem, number)
    universe = table.setdefault("universe", {})
    if isinstance(universe, dict):
        # The depth is not what is tested here: a deep catalogue takes hours.
        for key in ("galaxy_limit", "star_limit"):
            if isinstance(universe.get(key, 26.0), float):
                universe[key] = min(universe.get(key, 26.0), 18.0)
        universe |= {"box_cells": 192, "lensing_nside": 64} if universe.get("box_cells") != 0 else {}
    if problem_of_check(table):
        return
    simulate.run(table, tmp_path / "lake", limit=1)
