"""Settings are looked up: each accuracy takes the cheapest row of the measured tables that is within it."""

import csv
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import _positions as positions
from benchmarks._scenes import VIS, spread
from jobs.accuracy import DRAFT, REFERENCE, SURVEY
from jobs.render import psf, stamps

FOLDER = Path(stamps.__file__).parent


def rows(name):
    lines = [line for line in (FOLDER / name).read_text().splitlines() if not line.startswith("#")]
    return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(lines)]


@pytest.mark.parametrize("accuracy", [DRAFT, SURVEY, REFERENCE])
def test_no_cheaper_row_is_within_the_accuracy(accuracy):
    chosen = stamps.settings_for(accuracy)
    table = rows("settings.csv")
    mine = next(row for row in table if (row["edge"], row["least"]) == (chosen.edge, chosen.least))

    def within(row):
        return all(row[f"{field.name}_error"] <= getattr(accuracy, field.name) for field in fields(accuracy))

    assert within(mine) or (not any(map(within, table)) and mine["seconds"] == max(row["seconds"] for row in table))
    assert not any(within(row) and row["seconds"] < mine["seconds"] for row in table)


@pytest.mark.parametrize("accuracy", [DRAFT, SURVEY, REFERENCE])
def test_the_fewest_positions_whose_error_is_within_the_shape(accuracy):
    table = [row for row in rows("psf_positions.csv") if row["nearest"] == 0]
    assert [row["positions"] for row in table] == list(psf.DEGREES)
    chosen = stamps.settings_for(accuracy).positions
    for row in table:
        within = max(row["r2_rms"], row["ellipticity_error"]) <= accuracy.shape
        assert within == (row["positions"] >= chosen)


def test_more_is_asked_for_more_is_taken():
    tiers = [stamps.settings_for(accuracy) for accuracy in (DRAFT, SURVEY, REFERENCE)]
    for field in ("edge", "ghost", "floor"):
        assert sorted((getattr(tier, field) for tier in tiers), reverse=True) == [
            getattr(tier, field) for tier in tiers
        ]
    assert [tier.positions for tier in tiers] == sorted(tier.positions for tier in tiers)
    most = stamps.settings_for(replace(REFERENCE, shape=1e-12, background=1e-12))
    assert most.positions == max(psf.DEGREES)


def test_between_its_positions_the_psf_is_as_wrong_as_the_table_says():
    """Against the optics computed at the place of a star."""
    table = {row["positions"]: row for row in rows("psf_positions.csv") if row["nearest"] == 0}
    at = positions.optics()
    star, planes = positions.star(at, np.random.default_rng(8)), spread(VIS, 9).planes
    r2, ellipticity = positions.errors_of(at((0.0, 0.0)) + positions.drift(planes, star), star)
    assert r2 <= table[9]["r2_error"]
    assert ellipticity <= table[9]["ellipticity_error"]
    none, _ = positions.errors_of(at((0.0, 0.0)), star)
    assert none > 3 * r2
