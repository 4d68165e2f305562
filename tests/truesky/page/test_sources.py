"""A source in a lake whose requests have different tables."""

import json

import numpy as np

from lake_schema import ids
from lake_schema.store import layout, publish, read
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.fluxes import fluxes
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.variability.active_nuclei import ACTIVE_NUCLEI
from lake_schema.tables.variability.transients import TRANSIENTS
from tests.truesky.page.conftest import serving
from tests.universe import rows_of
from truesky.page import pictures, sources

NUMBER = 60


def test_spectra_of_a_lake_of_two_requests(tmp_path, monkeypatch):
    """The spectrum comes from the request that has the source, and from the libraries of its fluxes."""
    root, part, declared = tmp_path / "lake", Task(layout.cell_file(5, 1607), {}), fluxes("galaxy", ["euclid_vis"])
    root.mkdir()
    for seed, name in ((3, "a"), (4, "b")):
        rows = rows_of(GALAXIES, NUMBER, seed=seed)
        shared = {column: rows[column] for column in ("id", "ra", "dec", "_healpix_29")}
        light = np.full(NUMBER, float(seed))
        flux = declared.build({**shared, "f_nu_euclid_vis": light, "integrated": [False] * NUMBER})
        for table, found in ((GALAXIES, rows), (declared, flux)):
            plan = Plan(table, {"made_by": name}, (part,))
            publish.make_version(root, plan, lambda lake, facts, found=found: Output(found), name=name)
    made_of = []
    monkeypatch.setattr(
        sources.inputs, "galaxy_library_from_facts", lambda lake, facts: made_of.append(facts["made_by"])
    )
    grid = sources.passbands.grid()
    monkeypatch.setattr(
        sources.band_fluxes, "galaxy_spectra", lambda rows, library: np.full((1, len(grid)), rows["z_obs"][0].as_py())
    )
    tables = [read.version(root, "galaxies", request=name).rows(["id", "z_obs"]).to_pylist() for name in "ab"]
    with serving(root) as page:
        for name, own, other in (("a", *tables), ("b", *tables[::-1])):
            row = next(row for row in own if row["id"] not in {one["id"] for one in other})
            found = page.json(f"spectrum/{row['id']}")
            assert "said" not in found, found
            assert found["z"] == row["z_obs"]
            assert found["f_lambda"][0] == float(f"{row['z_obs']:.5g}")
            assert made_of[-1] == name
        assert "has no source 1 " in json.dumps(page.json("spectrum/1"))


def test_the_position_comes_from_the_request_that_has_the_source(tmp_path):
    root, part = tmp_path / "lake", Task(layout.cell_file(5, 1607), {})
    root.mkdir()
    rows = {name: rows_of(GALAXIES, number, seed=3) for name, number in (("a", NUMBER), ("b", NUMBER + 20))}
    for name in rows:
        plan = Plan(GALAXIES, {"made_by": name}, (part,))
        publish.make_version(root, plan, lambda lake, facts, name=name: Output(rows[name]), name=name)
    here = {name: {row["id"]: row for row in found.to_pylist()} for name, found in rows.items()}
    both, alone = next(iter(here["a"].keys() & here["b"])), next(iter(here["b"].keys() - here["a"]))
    with serving(root) as page:
        # A source of both requests has the row and the position of the first request.
        for own, request in ((both, "a"), (alone, "b")):
            found, row = page.json(f"source/{own}"), here[request][own]
            assert found["request"] == request
            assert found["place"] == [row["ra"], row["dec"]]
            values = {fact["name"]: fact["value"] for fact in found["tables"]["galaxies"]}
            assert [values["ra"], values["dec"]] == found["place"]
            assert ids.kind_from_id(np.array([own]))[0] == values["kind"]


def test_changing_sources_are_not_stars(tmp_path):
    root, part = tmp_path / "lake", Task(layout.cell_file(5, 1607), {})
    root.mkdir()
    cell = 1607 << 6
    numbers = np.arange(1, 3, dtype=np.uint64)
    supernovae, nuclei = ids.transient_id(cell, numbers), ids.transient_id(cell, numbers + np.uint64(70_000))
    tables = {}
    for table, column, found in ((TRANSIENTS, "id", supernovae), (ACTIVE_NUCLEI, "point_id", nuclei)):
        rows = rows_of(table, 2, seed=3)
        rows = rows.set_column(rows.schema.get_field_index(column), rows.schema.field(column), [found.tolist()])
        tables[table.name] = rows
        plan = Plan(table, {"made_by": "a"}, (part,))
        publish.make_version(root, plan, lambda lake, facts, rows=rows: Output(rows), name="a")
    with serving(root) as page:
        for table, kind, own in (("transients", "supernova", supernovae), ("active_nuclei", "active nucleus", nuclei)):
            found = page.json(f"source/{own[1]}")
            assert found["kind"] == kind
            assert found["place"] == [tables[table][name][1].as_py() for name in ("ra", "dec")]
            assert list(found["tables"]) == [table]
            assert "light_curve" in page.json(f"spectrum/{own[1]}")["said"]
        status, _, body = page.of_lake(f"source/{ids.transient_id(cell, np.array([9], np.uint64))[0]}")
        assert status == 400
        assert b"no source" in body
    star = ids.source_id(5, cell, np.arange(1))
    assert pictures.kind_names(np.concatenate([supernovae, star])) == ["changing source"] * 2 + ["star"]
