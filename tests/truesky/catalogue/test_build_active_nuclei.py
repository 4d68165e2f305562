"""Tests of the job that makes the table `active_nuclei`."""

from dataclasses import asdict

import pytest

from lake_schema.errors import BadInput
from lake_schema.store import plan, publish, read
from lake_schema.tables.galaxies import GALAXIES
from tests import requests
from tests.truesky.catalogue.nuclei import test_rows
from truesky.catalogue import build_active_nuclei
from truesky.catalogue.nuclei import rows
from truesky.cosmology import FIDUCIAL
from truesky.request.from_toml import parse


def made(folder, facts):
    """Publish the galaxies of one cell."""
    name = f"Norder=5/Dir=0/Npix={test_rows.CELL >> 6}.parquet"
    part = plan.Task(name, {"generation_cells": [test_rows.CELL]})
    facts = {"seed": 7, "cosmology": asdict(FIDUCIAL), **facts}
    publish.make_version(
        folder, plan.Plan(GALAXIES, facts, (part,)), lambda lake, facts: plan.Output(test_rows.drawn())
    )


def test_a_published_table(tmp_path):
    made(tmp_path, {"variables": True})
    path = requests.written(tmp_path, "[universe]\nvariables = true\n", seed=7)
    (step,) = build_active_nuclei.steps(tmp_path, parse(path))
    publish.make_version(tmp_path, step.plan, step.run_task)
    table = read.version(tmp_path, "active_nuclei").rows()
    expected = rows.draw(test_rows.drawn(), 7, test_rows.LAWS, FIDUCIAL)
    assert table.num_rows > 100
    assert table.equals(expected)


def test_a_request_without_variable_sources_is_refused(tmp_path):
    with pytest.raises(BadInput, match=r"^universe.variables is false: set it to true for active nuclei$"):
        build_active_nuclei.steps(tmp_path, parse(requests.written(tmp_path)))


def test_galaxies_without_variable_sources_are_refused(tmp_path):
    made(tmp_path, {"box_cells": 256})
    path = requests.written(tmp_path, "[universe]\nvariables = true\n", seed=7)
    with pytest.raises(BadInput, match="table galaxies has variables False, the request True: run truesky build"):
        build_active_nuclei.steps(tmp_path, parse(path))
