"""A source in a lake whose requests have different tables."""

import json

import numpy as np

from lake_schema import ids
from lake_schema.store import layout, publish, read
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.fluxes import fluxes
from lake_schema.tables.galaxies import GALAXIES
from tests.truesky.page.conftest import serving
from tests.universe import rows_of
from truesky.page import sources

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
