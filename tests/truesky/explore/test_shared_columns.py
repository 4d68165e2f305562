"""References to columns that a catalogue and its table of fluxes both have."""

import json
import re
from pathlib import Path

import duckdb
import numpy as np
import pytest

from lake_schema.tables import all_tables
from truesky.explore import guard, shared_columns

ROOT = Path(__file__).parents[3]
JOIN = "galaxies JOIN galaxy_fluxes USING (id)"


@pytest.mark.parametrize(
    "query",
    [
        f"SELECT ra, dec FROM {JOIN} ORDER BY id",
        f"SELECT 'é', \"ra\", RA AS other FROM {JOIN} WHERE ra > 1 AND _healpix_29 > 0 ORDER BY id",
        "SELECT ra FROM galaxies AS g JOIN galaxy_fluxes f ON g.id = f.id AND f.ra > 1 ORDER BY id",
        "SELECT ra FROM galaxies, galaxy_fluxes WHERE galaxies.id = galaxy_fluxes.id ORDER BY galaxies.id",
        "SELECT ra FROM galaxies LEFT JOIN galaxy_fluxes USING (id) ORDER BY id",
        "SELECT ra FROM galaxies RIGHT JOIN galaxy_fluxes USING (id) ORDER BY id",
        "WITH joined AS (SELECT id, ra FROM galaxy_fluxes JOIN galaxies USING (id)) SELECT ra FROM joined ORDER BY id",
        f"SELECT max(ra) FROM {JOIN} GROUP BY id, ra HAVING ra > 1 ORDER BY id",
        f"SELECT ra FROM {JOIN} JOIN (SELECT id, 1 AS one FROM galaxies) AS ones USING (id) ORDER BY id",
    ],
)
def test_shared_columns_are_resolved(explorer, galaxies, query):
    order = np.argsort(galaxies["id"].to_numpy())
    rows = explorer.sql(query, into="arrow")
    name = next(name for name in rows.column_names if name.lower().endswith(("ra", "ra)")))
    assert np.array_equal(rows[name].to_numpy(), galaxies["ra"].to_numpy()[order])


def test_queries_that_work_do_not_change(explorer, galaxies):
    ra = galaxies["ra"].to_numpy()
    assert explorer.sql(f"SELECT sum(galaxy_fluxes.ra) AS s FROM {JOIN}")["s"][0] == pytest.approx(ra.sum())
    names = list(explorer.sql(f"SELECT * FROM {JOIN} LIMIT 1").columns)
    assert {"ra", "f_nu_euclid_vis"} <= set(names)
    # The name of a result column takes precedence in ORDER BY.
    values = explorer.sql(f"SELECT -galaxies.ra AS ra FROM {JOIN} ORDER BY ra")["ra"].to_numpy()
    assert np.array_equal(values, np.sort(-ra))
    assert explorer.sql(f"SELECT list_transform([1, 2], lambda ra: ra + 1) AS x FROM {JOIN} LIMIT 1")["x"][0][0] == 2


@pytest.mark.parametrize(
    "query",
    [
        # Rows of the outer join lack one of the values, tables are not joined by id, or a third column has the name.
        "SELECT ra FROM galaxies FULL JOIN galaxy_fluxes USING (id)",
        "SELECT ra FROM galaxies, galaxy_fluxes",
        "SELECT ra FROM galaxies JOIN galaxy_fluxes ON galaxies.id > galaxy_fluxes.id",
        "SELECT ra FROM galaxies a JOIN galaxies b USING (id)",
        f"SELECT ra FROM {JOIN} JOIN (SELECT id, 1 AS ra FROM galaxies) AS ones USING (id)",
        f"SELECT ra FROM {JOIN} JOIN (SELECT * FROM galaxies) AS ones USING (id)",
        # The tables belong to different requests.
        "SELECT ra FROM a.galaxies JOIN b.galaxy_fluxes USING (id)",
    ],
)
def test_other_references_remain_ambiguous(query):
    assert qualified(query) == query


def bands_of(text):
    return sorted({*re.findall(r"f_nu_(\w+)", text), "euclid_vis"})


def columns_of(text):
    tables = {table.name: table for table in all_tables(bands_of(text))}
    requests = {f"{request}.{name}": table for request in "ab" for name, table in tables.items()}
    return {name: list(table.names) for name, table in (tables | requests).items()}


def qualified(text):
    columns = columns_of(text)
    return shared_columns.qualify(text, guard.check_query(text, columns).tree, columns)


def documented():
    """All queries in the docs and notebooks, without those that contain a place holder such as {band}."""
    texts = [path.read_text() for folder in ("docs", ".") for path in sorted((ROOT / folder).glob("*.md"))]
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        texts += ["".join(cell["source"]) for cell in json.loads(path.read_text())["cells"]]
    quoted = r'"""(.*?)"""|"([^"\n]*(?:\n[^"\n]+){0,6})"'
    queries = (a or b for text in texts for a, b in re.findall(quoted, text, re.DOTALL))
    return [" ".join(query.split()) for query in queries if re.match(r"\s*(SELECT|WITH) .* FROM ", query, re.DOTALL)]


def test_documented_queries():
    """A query of the docs that DuckDB accepts does not change, and all others work after the change."""
    left_out = r"[{}]|TOP |ivoa\.|POINT|'LAKE|'s3:|\b[ab]\.rendered"
    queries = [query for query in documented() if not re.search(left_out, query)]
    assert len(queries) >= 15
    for query in queries:
        # A parameter is a number or a list.
        text = re.sub(r"\$\w+", "1", query.replace("$ids", "[1]"))
        with duckdb.connect(":memory:") as opened:
            opened.execute("CREATE MACRO mag_ab(f_nu) AS f_nu")
            opened.execute("CREATE MACRO in_area(ra, dec) AS ra < dec")
            opened.execute("CREATE MACRO separation(ra1, dec1, ra2, dec2) AS ra1 + dec1 + ra2 + dec2")
            for table in all_tables(bands_of(query)):
                opened.register(table.name, table.arrow_schema().empty_table())
            try:
                opened.execute(text)
            except duckdb.BinderException:
                opened.execute(qualified(text))
            else:
                assert qualified(text) == text
