"""Catalogues of one universe can be used together; catalogues of different universes cannot."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest

from lake_schema.errors import BadInput
from lake_schema.store import layout, publish, read
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.store.provenance import file_sha256
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.stars import STARS
from tests import requests
from tests.universe import rows_of
from truesky.catalogue import build_galaxies, build_stars
from truesky.request import universe
from truesky.request.files import Catalogue, DustMap, Ingest
from truesky.request.from_toml import from_table, parse
from truesky.running import submitted_job

TABLES = {"galaxies": GALAXIES, "stars": STARS}
# Further facts that a build job adds.
ADDED = {"code", "lensing_l_max"}


@cache
def keys():
    """Return the keys of the facts that the job of each catalogue writes."""
    root, request = Path("/no/lake"), wanted()
    with pytest.MonkeyPatch.context() as patch:
        # Skip the computation of the box, on which the plan does not depend.
        patch.setattr(build_galaxies, "_universe", lambda *args: None)
        steps = [*build_galaxies.steps(root, request), *build_stars.steps(root, request)]
    return {step.plan.table.name: step.plan.facts.keys() - ADDED for step in steps if step.plan.table.name in TABLES}


def wanted(name="a", seed=11, **depth):
    area = {"cone": {"ra": 53.0, "dec": -27.0, "radius": 0.1}}
    return from_table({"name": name, "seed": seed, "area": area, "universe": depth})


def catalogue(lake, table, request, name=None, **facts):
    """Publish a catalogue as a build job would for a request."""
    own = {key: value for key, value in universe.requested_values(request).items() if key in keys()[table]}
    plan = Plan(TABLES[table], {**own, **facts}, (Task(layout.cell_file(5, 1607), {}),))
    publish.make_version(lake, plan, lambda root, facts: Output(rows_of(TABLES[table], 3)), name=name)
    return read.version(lake, table, plan.key)


def test_every_fact_of_a_catalogue_is_compared():
    """A fact that a build job writes and this module does not list would never be compared."""
    known = universe.requested_values(wanted())
    assert set().union(*keys().values()) <= known.keys()
    assert not known.keys() & {"rows_a_file", "tycho2", "catalogue", "columns"}


@pytest.mark.parametrize(
    ("table", "other", "words"),
    [
        ("galaxies", wanted(seed=12), "table galaxies has seed 11, the request 12: run truesky build first"),
        ("galaxies", wanted(galaxy_limit=24.0), "table galaxies has galaxy_limit 26.0, the request 24.0"),
        (
            "galaxies",
            wanted(cosmology={"w0": -0.9}),
            "table galaxies has the cosmology w0 = -1.0, the request w0 = -0.9: run truesky build first",
        ),
        ("stars", wanted(seed=12), "table stars has seed 11, the request 12: run truesky build first, then truesky fl"),
        ("stars", wanted(star_limit=20.0), "table stars has star_limit 26.0, the request 20.0"),
        (
            "stars",
            replace(wanted(), stars=replace(wanted().stars, density="besancon")),
            "table stars has density juric, the request besancon",
        ),
    ],
)
def test_message_names_the_difference_between_universes(lake, table, other, words):
    version = catalogue(lake, table, wanted())
    universe.check_catalogues([version], wanted())
    with pytest.raises(BadInput, match=words):
        universe.check_catalogues([version], other)


def test_variable_stars_are_another_universe():
    """Catalogues without this fact have constant stars; galaxies do not depend on it."""
    assert "variables" not in keys()["galaxies"] | keys()["stars"]
    constant, variable = wanted(), wanted(variables=True)
    old = {"seed": 11, "star_limit": constant.universe.star_limit}
    stars, galaxies = (SimpleNamespace(table=table, manifest={"facts": old}) for table in ("stars", "ingested"))
    universe.check_catalogues([stars, galaxies], constant)
    universe.check_catalogues([galaxies], variable)
    with pytest.raises(BadInput, match="table stars has variables False, the request True"):
        universe.check_catalogues([stars], variable)
    new = SimpleNamespace(table="stars", manifest={"facts": {**old, "variables": True}})
    universe.check_catalogues([new], variable)
    with pytest.raises(BadInput, match="table stars has variables True, the request False"):
        universe.check_catalogues([new], constant)


def test_galaxies_of_earlier_versions_are_another_universe():
    """They name neither the cosmology nor the structure below the cells of the box, which they did not have."""
    old = SimpleNamespace(table="galaxies", manifest={"facts": {"seed": 11, "box_cells": wanted().universe.box_cells}})
    with pytest.raises(BadInput, match="table galaxies has structure_below_cells False, the request True"):
        universe.check_catalogues([old], wanted())
    with pytest.raises(BadInput, match="has the cosmology power = eisenstein98, the request power = camb"):
        universe.check_catalogues([old], wanted(structure_below_cells=False))
    universe.check_catalogues([old], wanted(cosmology={"power": "eisenstein98"}, structure_below_cells=False))
    # A user's galaxies depend on distances only.
    given = SimpleNamespace(table="galaxies", manifest={"facts": {"seed": 11}})
    universe.check_catalogues([given], wanted())
    with pytest.raises(BadInput, match=r"has the cosmology h = 0\.67, the request h = 0\.7"):
        universe.check_catalogues([given], wanted(cosmology={"h": 0.7, "power": "eisenstein98"}))


def test_differences_of_the_other_catalogue_are_ignored(lake):
    universe.check_catalogues([catalogue(lake, "galaxies", wanted())], wanted(star_limit=20.0))


def test_files_are_compared_by_contents(lake, tmp_path):
    file, same, other = (tmp_path / f"{name}.csv" for name in ("file", "same", "other"))
    for path, text in ((file, "1"), (same, "1"), (other, "2")):
        path.write_text(text)

    def request(*paths):
        return replace(wanted(), ingest=Ingest(galaxies=Catalogue(paths, "euclid")))

    def about(*paths):
        return {"sha256": [file_sha256(path) for path in paths], "format": "euclid", "columns": {}}

    version = catalogue(lake, "galaxies", wanted(), ingest=about(file))
    for path in (file, same):
        universe.check_catalogues([version], request(path))
    with pytest.raises(BadInput, match="table galaxies has other files of ingest than the request"):
        universe.check_catalogues([version], request(other))
    with pytest.raises(BadInput, match="table galaxies has files of ingest, the request none"):
        universe.check_catalogues([version], wanted())
    # An additional or missing file makes another catalogue.
    with pytest.raises(BadInput, match="table galaxies has other files of ingest than the request"):
        universe.check_catalogues([version], request(file, other))
    two = catalogue(lake, "galaxies", wanted(), ingest=about(file, other))
    with pytest.raises(BadInput, match="table galaxies has other files of ingest than the request"):
        universe.check_catalogues([two], request(file))
    file.unlink()
    universe.check_catalogues([version], request(file))


def test_files_are_compared_by_reading_options(lake, tmp_path):
    (file := tmp_path / "file.csv").write_text("1")
    sums = {"sha256": [file_sha256(file)]}

    def request(columns, form="euclid", **kind):
        given = Catalogue((file,), form, (("z_true", columns),))
        return replace(wanted(), ingest=Ingest(**{kind.get("kind", "galaxies"): given}))

    about = {**sums, "format": "euclid", "columns": {"z_true": '"z"'}}
    version = catalogue(lake, "galaxies", wanted(), ingest=about)
    universe.check_catalogues([version], request('"z"'))
    with pytest.raises(BadInput, match="table galaxies has format of ingest euclid, the request flagship2: run"):
        universe.check_catalogues([version], request('"z"', "flagship2"))
    with pytest.raises(BadInput, match=r"table galaxies has columns of ingest .*, the request .*zz"):
        universe.check_catalogues([version], request('"zz"'))
    for kind in ("halos", "training"):
        version = catalogue(lake, "galaxies", wanted(), **{kind: {**sums, "columns": {"z_true": '"z"'}}})
        universe.check_catalogues([version], request('"z"', "", kind=kind))
        with pytest.raises(BadInput, match=f"table galaxies has columns of {kind} "):
            universe.check_catalogues([version], request('"zz"', "", kind=kind))


@pytest.mark.parametrize("listed", [True, False])
def test_pairs_of_files_are_compared_and_other_files_ignored(lake, tmp_path, listed):
    names = ("galaxy_1.parquet", "galaxy_flux_1.parquet", "pointsource_1.parquet")
    for name in names:
        (tmp_path / name).write_text(name)
    sums = [file_sha256(tmp_path / name) for name in names[:2]]
    version = catalogue(lake, "galaxies", wanted(), ingest={"sha256": sums, "format": "skycatalogs", "columns": {}})
    given = Catalogue((tmp_path / names[0] if listed else tmp_path,), "skycatalogs")
    request = replace(wanted(), ingest=Ingest(galaxies=given))
    universe.check_catalogues([version], request)
    (tmp_path / names[1]).write_text("other")
    with pytest.raises(BadInput, match="other files of ingest"):
        universe.check_catalogues([version], request)


def test_dust_map_affects_both_catalogues(lake, tmp_path):
    (tmp_path / "dust.fits").write_text("x")
    dust = Ingest(dust=DustMap(tmp_path / "dust.fits", "EBV", "ebv", "", ""))
    for table in TABLES:
        with pytest.raises(BadInput, match=f"table {table} has no files of dust, the request some"):
            universe.check_catalogues([catalogue(lake, table, wanted())], replace(wanted(), ingest=dust))


def test_a_lake_holds_one_universe(lake):
    for table in TABLES:
        catalogue(lake, table, wanted("a"), name="a")
    universe.check_lake(lake, wanted("b"))
    with pytest.raises(
        BadInput, match=r"holds the universe of request a: its galaxies have seed 11, the request 12: use"
    ):
        universe.check_lake(lake, wanted("b", seed=12))
    with pytest.raises(BadInput, match=r"its stars have star_limit 26.0, .*: use another folder for request b"):
        universe.check_lake(lake, wanted("b", star_limit=20.0))
    # A request that is alone in its lake may change its universe.
    universe.check_lake(lake, wanted("a", seed=12))


def test_every_job_compares_universes_first(lake, tmp_path, capsys):
    catalogue(lake, "stars", wanted("a"), name="a")
    before = sorted(lake.rglob("*"))
    job = submitted_job.Job("toy", "", lambda root, request: pytest.fail("it began"))
    file = requests.written(tmp_path, seed=12)
    assert submitted_job.main(job, ["--lake", str(lake), "--request", str(file)]) == 2
    assert capsys.readouterr().err.endswith(
        f"lake {lake} holds the universe of request a: its stars have seed 11, the request 12: use another folder for "
        f"request {parse(file).name}\n"
    )
    assert sorted(lake.rglob("*")) == before
