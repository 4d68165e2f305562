"""Each check of catalogues passes for a correct catalogue and fails for the fault that it must detect."""

from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest

from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from truesky.validation.lake.catalogues import duplicates, requirements
from truesky.validation.verdicts import FAIL, NOT_APPLICABLE, PASS, UNDECIDED

CELLS = np.arange(400_000, 400_009)


class Version:
    """Stand-in for a published table with the attributes that checks use."""

    def __init__(self, name, columns, cells=CELLS):
        self.table, self.data = name, pa.table(columns)
        self.schema = SimpleNamespace(names=self.data.column_names)
        self.manifest = {"parts": [{"facts": {"generation_cells": [int(c) for c in cells]}}]}

    def rows(self, columns):
        return self.data.select(columns)


def galaxies(seed=1, per_cell=12_000, z=1.0, line=5e-16, **more):
    """Galaxies in nine cells; a quarter are emitters."""
    rng = np.random.default_rng(seed)
    parts = [sky.random_in_cell(GENERATION_ORDER, int(cell), per_cell, rng) for cell in CELLS]
    index, ra, dec = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    n = len(ra)
    columns = {
        "id": np.arange(n), "ra": ra, "dec": dec, "_healpix_29": index, "z_obs": z * (0.5 + rng.random(n)),
        "flux_halpha": np.where(rng.random(n) < 0.25, line, 0.0), "density_boost": np.ones(n, np.float32),
    }  # fmt: skip
    return columns | more


def light(columns, mag=24.0):
    n = len(columns["id"])
    rng = np.random.default_rng(4)
    # The rows of fluxes are in another order.
    order = rng.permutation(n)
    flux = np.full(n, 10 ** (-0.4 * (mag - 23.9)))
    return Version("galaxy_fluxes", {"id": columns["id"][order], "f_nu_euclid_vis": flux})


def verdicts(rows):
    return {row.quantity: row.verdict for row in rows}


def test_no_source_twice():
    found = verdicts(duplicates.rows(Version("galaxies", galaxies(per_cell=500))))
    assert found == dict.fromkeys(("galaxies_ids", "galaxies_places", "galaxies_densest_cell"), PASS)


def test_a_duplicated_cell_is_found():
    """The copies have the same identifiers, other identifiers, or other identifiers and slightly shifted positions."""
    good = galaxies(per_cell=500)
    for quantity, move in (("galaxies_ids", 0.0), ("galaxies_places", 0.0), ("galaxies_densest_cell", 1e-5)):
        again = {name: values[:500].copy() for name, values in good.items()}
        if quantity != "galaxies_ids":
            again["id"] += 10_000_000
        again["ra"] += move
        both = {name: np.concatenate([good[name], again[name]]) for name in good}
        found = verdicts(duplicates.rows(Version("galaxies", both)))
        assert found[quantity] == FAIL
        assert found["galaxies_densest_cell"] == FAIL


def test_stars_are_not_counted_by_cell():
    found = verdicts(duplicates.rows(Version("stars", galaxies(per_cell=500))))
    assert found == {"stars_ids": PASS, "stars_places": PASS}


def test_requirements_of_the_sky():
    columns = galaxies()
    found = verdicts(requirements.rows(Version("galaxies", columns), light(columns)))
    assert {name for name, verdict in found.items() if verdict == PASS} == {
        "galaxies_24.5", "median_redshift", "halpha_emitters",
    }  # fmt: skip
    assert found["jitter"] == NOT_APPLICABLE


@pytest.mark.parametrize(
    ("quantity", "columns", "mag"),
    [
        ("galaxies_24.5", {"per_cell": 3_000}, 24.0),
        ("galaxies_24.5", {}, 24.6),
        ("median_redshift", {"z": 0.75}, 24.0),
        ("halpha_emitters", {"line": 1.9e-16}, 24.0),
    ],
)
def test_requirements_that_are_not_met(quantity, columns, mag):
    table = galaxies(**columns)
    found = verdicts(requirements.rows(Version("galaxies", table), light(table, mag)))
    assert found[quantity] in ((FAIL,) if mag < 24.5 else (FAIL, UNDECIDED))


def test_empty_tables_are_not_applicable():
    (row,) = duplicates.rows(Version("galaxies", galaxies(per_cell=0)))
    assert (row.verdict, row.quantity) == (NOT_APPLICABLE, "galaxies")
    assert row.note == "table galaxies has no rows"


@pytest.mark.parametrize("kept", [0, 5, 89])
def test_fluxes_of_other_galaxies_are_refused(kept):
    columns = galaxies(per_cell=10)
    fluxes = light({name: values[:kept] for name, values in columns.items()})
    rows = requirements.rows(Version("galaxies", columns), fluxes)
    assert {row.verdict for row in rows} == {NOT_APPLICABLE}
    assert "lacks galaxies" in rows[-1].note


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ({"galaxy_limit": 22.0}, "ends at 22 in euclid_vis"),
        ({"galaxy_limit": 26.0, "galaxy_band": "lsst_r"}, "ends at 26 in lsst_r"),
        ({"galaxy_limit": 24.5, "galaxy_band": "euclid_vis"}, ""),
    ],
)
def test_a_catalogue_that_ends_before_the_requirements_do_does_not_fail_them(facts, words):
    columns = galaxies()
    version = Version("galaxies", columns)
    version.manifest["facts"] = facts
    rows = requirements.rows(version, light(columns))
    if words:
        assert {row.verdict for row in rows} == {NOT_APPLICABLE}
        assert words in rows[-1].note
    else:
        assert verdicts(rows)["galaxies_24.5"] == PASS


def test_missing_band_is_not_applicable():
    columns = galaxies(per_cell=10)
    fluxes = Version("galaxy_fluxes", {"id": columns["id"]})
    rows = requirements.rows(Version("galaxies", columns), fluxes)
    assert all(row.verdict == NOT_APPLICABLE and row.note for row in rows)
