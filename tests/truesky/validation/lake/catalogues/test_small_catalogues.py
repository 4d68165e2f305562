"""Checks of catalogues with few galaxies or a single cell give reasons, and numpy prints no warnings."""

import numpy as np
import pytest

from lake_schema.ids import GENERATION_ORDER
from lake_schema.tables.galaxies import GALAXIES
from tests.truesky.validation.lake.catalogues import mocks
from tests.truesky.validation.lake.catalogues.test_faults import Version
from tests.universe import rows_of
from truesky.cosmology import FIDUCIAL
from truesky.validation import __main__
from truesky.validation import field as fields
from truesky.validation.lake.catalogues import colours, cosmic_shear, observed_sky
from truesky.validation.lake.suite import publishing
from truesky.validation.verdicts import PASS

# Galaxies at redshift 0.5 with one spectrum.
PLAIN = {
    "kind": 0, "z_true": 0.5, "z_obs": 0.5, "abs_mag_r01": -21.0, "mag_r01": 22.0, "sed_1": 10, "sed_2": 10,
    "frac_1": 0.5, "frac_2": 0.5, "ext_law_1": 0, "ext_law_2": 0, "ebv_1": 0.1, "ebv_2": 0.1, "a_v": 0.1,
    "density_boost": 1.0,
}  # fmt: skip
pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


def reasons(rows):
    """Return the reasons of all rows that do not pass, as the command prints them."""
    listed = publishing.build_table(rows).to_pylist()
    unknown = [row for row in listed if row["verdict"] != PASS and None in (row["value"], row["error"])]
    assert all(row["note"] for row in unknown)
    return [__main__._reason(row) for row in listed if row["verdict"] in ("fail", "undecided")]


@pytest.mark.parametrize(
    ("number", "cells", "reason"),
    [
        (0, 1, "the table galaxies has no rows"),
        (1, 1, "no galaxy of the catalogue is in this range"),
        (40, 1, "too small an area: 1 HEALPix cells < 4"),
        (40, 40, "no galaxy of the catalogue is in this range"),
    ],
)
def test_observed_galaxies(number, cells, reason):
    table = rows_of(GALAXIES, max(number, 1)).slice(0, number)
    columns = {name: table[name].to_numpy().copy() for name in table.column_names}
    if cells == 1:
        columns["_healpix_29"][:] = columns["_healpix_29"][:1]
    columns |= {name: np.full(number, value, columns[name].dtype) for name, value in PLAIN.items()}
    galaxies = Version("galaxies", columns, cells=[400_000])
    rows = observed_sky.measure(galaxies).rows
    assert all(reasons(rows))
    assert any(reason in row.note for row in rows)


def test_shear_in_one_cell():
    columns = mocks.sheared(n=30_000)
    selected = columns["_healpix_29"] >> 2 * (29 - GENERATION_ORDER) == mocks.CELLS[0]
    one_cell = {name: values[selected] for name, values in columns.items()}
    result = cosmic_shear.compare(one_cell, fields.from_cells(GENERATION_ORDER, mocks.CELLS[:1]), FIDUCIAL)
    unknown = [row for row in result.rows if not np.isfinite([row.value, row.error]).all()]
    assert all(row.note.startswith(("too few pairs of galaxies", str(selected.sum()))) for row in unknown)
    assert reasons(result.rows) or not unknown


def test_the_median_of_colours_needs_no_second_patch():
    value, error = colours._median(np.array([0.1, 0.2, 0.3]), np.zeros(3, int), 1)
    assert (value, error) == pytest.approx((0.2, 1.25 * np.std([0.1, 0.2, 0.3]) / np.sqrt(3.0)))
