"""Files of galaxies by observed position: an interrupted run resumes and gives the same result."""

import os
import signal
import tomllib

import numpy as np
import pytest

from lake_schema import ids, sky
from lake_schema.store import publish, read
from tests.faults import victims
from tests.test_jobs import SMALL
from truesky.catalogue import build_galaxies
from truesky.request.from_toml import from_table


def galaxies_of(root):
    root.mkdir(parents=True, exist_ok=True)
    steps = build_galaxies.steps(root, from_table(tomllib.loads(SMALL)))
    return next(step for step in steps if step.plan.table.name == "galaxies")


def killed_at(root, number):
    """Run a build that is killed while it draws the galaxies of its n-th file."""
    step, begun = galaxies_of(root), []

    def work(lake, facts):
        begun.append(facts)
        rows = step.run_task(lake, facts)
        if len(begun) == number:
            os.kill(os.getpid(), signal.SIGKILL)
        return rows

    publish.make_version(root, step.plan, work)


def made(root):
    """Return the number of files that a run draws, and the key of the version."""
    step, begun = galaxies_of(root), []

    def work(lake, facts):
        begun.append(facts)
        return step.run_task(lake, facts)

    publish.make_version(root, step.plan, work)
    version = read.version(root, "galaxies")
    return len(begun), (version.folder / "manifest.json").read_bytes(), version


@pytest.mark.nightly
def test_a_run_that_is_killed_goes_on_with_the_same_galaxies(tmp_path):
    """Four files that meet at a corner and draw each other's surroundings: every galaxy is in exactly one of them."""
    drawn, wanted, version = made(tmp_path / "whole")
    assert drawn == 4
    for number in (1, 3):
        root = tmp_path / f"killed at {number}"
        assert victims.run(killed_at, root, number) == -signal.SIGKILL
        assert made(root)[:2] == (5 - number, wanted)
    rows = version.rows(["id", "ra", "dec", "ra_true", "dec_true"])
    assert np.unique(rows["id"].to_numpy()).size == len(rows) > 100
    seen, true = (
        sky.cell_at(rows[ra].to_numpy(), rows[dec].to_numpy(), ids.GENERATION_ORDER)
        for ra, dec in (("ra", "dec"), ("ra_true", "dec_true"))
    )
    assert np.count_nonzero(seen != true) > 3
