"""One small lake, and one explorer of it, for all tests of this folder."""

import pytest

from lake_schema.columns import Column, Table
from lake_schema.store import layout, publish
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.fluxes import fluxes
from lake_schema.tables.galaxies import GALAXIES
from tests.universe import PLAIN, plain_plan, plain_work, rows_of
from tests.waiting import PATIENCE
from truesky.explore.explorer import Explorer

ROWS = 500
LISTS = Table(
    "lists", 1, (PLAIN.columns[0], Column("stars", "list<float32>", "uJy", "phot.flux.density", "fluxes")), "Lists."
)
FLUXES = fluxes("galaxy", ["euclid_vis"])


def make_lake(root, num_galaxies):
    """Make a lake of galaxies with fluxes, one plain table and one table of lists, and return its folder."""
    root.mkdir()
    part = Task(layout.cell_file(5, 1607), {})
    galaxies = rows_of(GALAXIES, num_galaxies, seed=3)
    shared = {name: galaxies[name] for name in ("id", "ra", "dec", "_healpix_29")}
    flux = FLUXES.build({**shared, "f_nu_euclid_vis": galaxies["bulge_fraction"], "integrated": [False] * num_galaxies})
    for table, rows in ((GALAXIES, galaxies), (FLUXES, flux)):
        publish.make_version(root, Plan(table, {}, (part,)), lambda lake, facts, rows=rows: Output(rows))
    publish.make_version(root, plain_plan(), plain_work)
    lists = LISTS.build({"id": [1, 2], "stars": [[1.0, 2.0], [3.0]]})
    publish.make_version(root, Plan(LISTS, {}, (Task("0.parquet", {}),)), lambda lake, facts: Output(lists))
    return root


@pytest.fixture(scope="package")
def explored(tmp_path_factory):
    return make_lake(tmp_path_factory.mktemp("explored") / "lake", ROWS)


@pytest.fixture(scope="package")
def galaxies():
    return rows_of(GALAXIES, ROWS, seed=3)


@pytest.fixture(scope="package")
def explorer(explored):
    with Explorer(explored, timeout=PATIENCE) as opened:
        yield opened
