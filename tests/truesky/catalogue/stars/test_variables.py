"""Variable stars in the table: the other columns stay as they are, and light curves follow from the rows."""

import dataclasses

import numpy as np
import pytest

from lake_schema.store import validate
from lake_schema.tables import stars as declarations
from tests.truesky.catalogue.conftest import SEED
from truesky.catalogue.stars import stars
from truesky.fluxes import passbands
from truesky.variability import variable_stars

# l = 338.7, b = -13.8; H < 19
CELL = 673_115


@pytest.fixture(scope="module")
def cells(dust):
    model = stars.model(19.0)
    return [stars.draw(CELL, SEED, dataclasses.replace(model, variables=on), dust) for on in (False, True)]


def test_other_columns_stay_as_they_are(cells):
    plain, variable = cells
    assert plain.schema.equals(declarations.STARS.arrow_schema(), check_metadata=True)
    assert variable.select(plain.column_names).equals(plain)
    assert validate.find_violations(variable, declarations.stars(True)) == []


def test_binaries_with_eclipses(cells):
    """Both stars of a pair have the same period, and are rows of the table."""
    rows = cells[1].to_pandas()
    second = rows[rows["variability"].isin([6, 7]) & rows["companion_of"].notna()]
    assert len(second) > 10
    pairs = second.merge(rows, left_on="companion_of", right_on="id", suffixes=("", "_of_primary"))
    both = pairs[pairs["variability_of_primary"].isin([6, 7])]
    assert len(both) > 5
    assert np.array_equal(both["period"], both["period_of_primary"])
    variable = rows[rows["variability"].notna()]
    for name in ("period", "epoch", "amplitude"):
        assert variable[name].notna().all()
    assert rows[rows["variability"].isna()][["period", "epoch", "amplitude"]].isna().all().all()
    # About 1 % of the stars vary.
    assert 3e-3 < len(variable) / len(rows) < 3e-2


def test_light_curves_of_rows(cells):
    read = variable_stars.read_columns(cells[1])
    factors = variable_stars.flux_factors(read, passbands.load("euclid_vis"), np.linspace(60_800.0, 70_000.0, 300))
    constant = read["variability"] == 0
    assert np.all(factors[constant] == 1.0)
    assert np.all(factors >= 0.0)
    assert np.sum(np.ptp(factors[~constant], axis=1) > 0.01) > 20
