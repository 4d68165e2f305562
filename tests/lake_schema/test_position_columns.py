"""Observed and true positions, in lakes of now and of an earlier time; which are not mixed."""

import pyarrow as pa
import pytest

from lake_schema import position_columns, sky
from lake_schema.errors import BadInput
from lake_schema.store import read
from lake_schema.tables import declared
from lake_schema.tables.stars import STARS
from tests import earlier
from tests.universe import rows_of
from truesky.catalogue import build_strong_lenses
from truesky.explore.explorer import Explorer
from truesky.fluxes import compute_fluxes
from truesky.render.sources import catalogue_rows
from truesky.request.from_toml import from_table

TABLES = "galaxies", "galaxy_fluxes", "strong_lenses"


@pytest.fixture(scope="module", params=[True, False], ids=["of before", "of now"])
def lake(request, tmp_path_factory):
    root = tmp_path_factory.mktemp("places") / "lake"
    return root, earlier.write(root, is_earlier=request.param), request.param


@pytest.fixture
def mixed(tmp_path):
    """Galaxies of now beside fluxes of before."""
    earlier.write(tmp_path / "lake")
    earlier.write(tmp_path / "lake", is_earlier=False, and_fluxes=False)
    return tmp_path / "lake"


def test_a_lake_of_before_is_read_as_it_was_written(lake):
    root, rows, is_earlier = lake
    for name in TABLES:
        version = read.version(root, name)
        assert read.verify(version, deep=True) == []
        assert position_columns.is_indexed_by_true(version) is is_earlier
    assert read.version(root, "galaxies").rows().equals(rows)
    assert 0.3 * earlier.AWAY < read.version(root, "galaxies").deflection() < earlier.AWAY


def test_a_cone_finds_what_is_seen_in_it(lake):
    """Whatever the lake's age: at every tenth source's place, it and nothing that is seen elsewhere."""
    root, rows, _ = lake
    version = read.version(root, "galaxies")
    seen = [rows[name].to_numpy() for name in version.place()]
    for row in range(0, earlier.ROWS, 10):
        ra, dec = (float(axis[row]) for axis in seen)
        found = version.cone(ra, dec, 1.0 / 3600.0, ["id"])["id"].to_pylist()
        wanted = sky.separation(*seen, ra, dec) <= 1.0 / 3600.0
        assert rows["id"][row].as_py() in found
        assert sorted(found) == sorted(rows["id"].to_numpy()[wanted].tolist())
        assert found == version.cone(ra, dec, 1.0 / 3600.0, ["id"], "lensed")["id"].to_pylist()


def test_what_is_rendered_is_where_it_is_seen(lake):
    root, rows, is_earlier = lake
    version, light = (read.version(root, name) for name in ("galaxies", "galaxy_fluxes"))
    ra, dec = (float(rows[name][7].as_py()) for name in version.place())
    task = {"ra": ra, "dec": dec, "radius": 0.05}
    columns = ("id", "ra", "dec", "z_obs")
    found, _, _ = catalogue_rows.sources(version, light, task, columns, ["euclid_vis"], 0.0, 0.0)
    assert tuple(found.column_names) == columns
    row = found["id"].to_pylist().index(rows["id"][7].as_py())
    assert (found["ra"][row].as_py(), found["dec"][row].as_py()) == (ra, dec)
    lens = read.version(root, "strong_lenses").rows()[3:4]
    at = {**task, **{k: lens[name][0].as_py() for k, name in zip(("ra", "dec"), version.place(), strict=True)}}
    drawn = catalogue_rows.lenses(read.version(root, "strong_lenses"), at, version.padding(), 0.0, 0.0)
    assert lens["id"][0].as_py() in drawn["id"].to_pylist()
    assert (catalogue_rows.deflection_of(version) > 0.0) is is_earlier
    none = found.slice(0, 0), light.rows(["id", "f_nu_euclid_vis"]).slice(0, 0)
    behind, _ = catalogue_rows.with_lensed(none, pa.table({"source_id": rows["id"][7:8]}), version, light, task, 0.0)
    assert behind.equals(found.slice(row, 1))


def test_fluxes_of_before_have_no_observed_places(lake):
    root, rows, is_earlier = lake
    fluxes, ra, dec = read.version(root, "galaxy_fluxes"), *(float(rows[name][0].as_py()) for name in ("ra", "dec"))
    assert rows["id"][0].as_py() in fluxes.cone(ra, dec, 1e-6, ["id"], "true")["id"].to_pylist()
    if is_earlier:
        with pytest.raises(
            BadInput, match="table galaxy_fluxes is indexed by true positions, as earlier versions of truesky wrote it"
        ):
            fluxes.cone(ra, dec, 1e-6)
    else:
        assert rows["id"][0].as_py() in fluxes.cone(ra, dec, 1e-6)["id"].to_pylist()


def test_earlier_names_are_understood_for_a_version(tmp_path):
    rows = earlier.write(tmp_path / "lake", is_earlier=False)
    version = read.version(tmp_path / "lake", "galaxies")
    asked = version.rows(["id", "ra_lensed", "dec_lensed", "ra"])
    assert asked.column_names == ["id", "ra_lensed", "dec_lensed", "ra"]
    assert asked["ra_lensed"].equals(rows["ra"])
    assert asked["dec_lensed"].equals(rows["dec"])
    ra, dec = (float(rows[name][0].as_py()) for name in ("ra", "dec"))
    assert version.cone(ra, dec, 1e-3, ["ra_lensed"]).column_names == ["ra_lensed"]
    cells = sky.cell_of([ra], [dec], 8).tolist()
    assert version.in_cells(cells, 8, ["dec_lensed"])["dec_lensed"].equals(version.in_cells(cells, 8)["dec"])
    assert version.margin(version.parts[0], ["ra_lensed"]).column_names == ["ra_lensed"]
    assert "ra_lensed" not in version.schema.names
    with pytest.raises(BadInput, match="table galaxies has no column speed"):
        version.rows(["speed"])
    with Explorer(tmp_path / "lake") as explorer:
        for _ in range(2):
            both = explorer.sql("SELECT ra, g.ra_lensed, dec_lensed AS d, dec FROM galaxies AS g", into="arrow")
            assert both["ra"].equals(both["ra_lensed"])
            assert both["d"].equals(both["dec"])
            assert explorer.sql("SELECT * FROM galaxies LIMIT 1", into="arrow").column_names == version.schema.names
        with pytest.raises(BadInput, match="speed"):
            explorer.sql("SELECT speed FROM galaxies")


def test_an_earlier_name_leads_to_a_column_that_there_is():
    for table in declared(["vis"]):
        assert all(own in table.names and name not in table.names for name, own in table.aliases)


def test_tables_of_before_and_of_now_are_not_mixed(mixed):
    line = (
        "table galaxy_fluxes is indexed by true positions, as earlier versions of truesky wrote it, "
        "table galaxies by observed ones"
    )
    with pytest.raises(BadInput, match=f"^{line}: run compute_fluxes first$"):
        position_columns.refuse_mixed(read.version(mixed, name) for name in ("galaxies", "galaxy_fluxes"))
    position_columns.refuse_mixed(read.version(mixed, name) for name in ("galaxy_fluxes", "strong_lenses"))
    with Explorer(mixed) as explorer:
        assert len(explorer.sql("SELECT f_nu_euclid_vis FROM galaxy_fluxes")) == earlier.ROWS
        with pytest.raises(BadInput, match=line):
            explorer.sql("SELECT count(*) FROM galaxies JOIN galaxy_fluxes USING (id)")


@pytest.mark.parametrize("job", [compute_fluxes, build_strong_lenses])
def test_nothing_new_is_made_of_galaxies_of_before(tmp_path, job, monkeypatch):
    earlier.write(tmp_path / "lake")
    earlier.published(tmp_path / "lake", STARS, rows_of(STARS, 20))
    monkeypatch.setattr("truesky.request.universe.refuse_other", lambda versions, request: list(versions))
    wanted = from_table({"name": "x", "seed": 3, "area": {"cone": {"ra": 10.0, "dec": 0.0, "radius": 0.1}}})
    with pytest.raises(BadInput, match=r"table galaxies is indexed by true .*: run build_galaxies first"):
        job.steps(tmp_path / "lake", wanted)
