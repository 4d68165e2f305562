"""The SQL function in_area selects the positions in the area of a request, as the request itself tests them."""

import json

import duckdb
import numpy as np
import pytest

from lake_schema.errors import BadInput, Damaged
from lake_schema.store import publish, request_links
from lake_schema.store.provenance import digest
from tests.universe import plain_plan, plain_work
from truesky.explore import requested_area
from truesky.explore.explorer import Explorer
from truesky.explore.session import _MACROS
from truesky.request import area

AREAS = {
    "cone": {"cone": {"ra": 359.9, "dec": -30.0, "radius": 2.0}},
    "box": {"box": {"ra": [350.0, 10.0], "dec": [-40.0, -20.0]}},
    "polygon": {"polygon": [[10.0, -10.0], [350.0, -20.0], [0.0, -40.0], [20.0, -30.0]]},
    "patches": {"patches": [[0.0, -30.0, 3.0], [4.0, -28.0, 2.0], [90.0, 0.0, 5.0]]},
    "wide": {"wide": True},
}


def places():
    """Positions over the whole sky, and as many near the areas."""
    rng = np.random.default_rng(5)
    ra, dec = rng.uniform(0.0, 360.0, 4000), np.degrees(np.arcsin(rng.uniform(-1.0, 1.0, 4000)))
    ra[2000:], dec[2000:] = rng.uniform(-15.0, 15.0, 2000) % 360.0, rng.uniform(-45.0, -5.0, 2000)
    return ra, dec


def recorded(root, name, section):
    """Record the area of a request with one table in a lake."""
    publish.make_version(root, plain_plan(), plain_work, name=name)
    request_links.write_area(root, name, as_json(area.parse(section)))


def as_json(shape):
    return json.loads(json.dumps({name: getattr(shape, name) for name in shape.__slots__}))


@pytest.mark.parametrize("form", AREAS)
def test_positions_are_those_of_the_request(form):
    shape = area.parse(AREAS[form])
    ra, dec = places()
    database = duckdb.connect()
    for command in _MACROS:
        database.execute(command)
    database.execute(f"CREATE MACRO in_area(ra, dec) AS ({requested_area.condition(shape)})")
    listed = {"ra": ra.tolist(), "dec": dec.tolist()}
    rows = database.execute("SELECT in_area(x, y) FROM (SELECT unnest($ra) AS x, unnest($dec) AS y)", listed).fetchall()
    inside = np.array([row[0] for row in rows])
    # Positions at the edge may differ by rounding.
    clear = np.abs(shape.depth(ra, dec)) > 1e-9
    assert np.array_equal(inside[clear], shape.contains(ra, dec)[clear])
    assert 0 < inside.sum() < inside.size


def test_a_lake_selects_the_area_of_its_request(lake):
    recorded(lake, "a", AREAS["cone"])
    with Explorer(lake) as explorer:
        text = "SELECT in_area(0.0, -30.0) AS inside, in_area(5.0, -30.0) AS outside, a.in_area(0, -30) AS named"
        assert explorer.sql(text).iloc[0].tolist() == [True, False, True]


def test_different_areas_need_the_name_of_the_request(lake):
    recorded(lake, "a", AREAS["cone"])
    recorded(lake, "b", AREAS["box"])
    with Explorer(lake) as explorer:
        with pytest.raises(BadInput, match=r"write REQUEST\.in_area"):
            explorer.sql("SELECT in_area(0.0, -30.0)")
        assert explorer.sql("SELECT b.in_area(5.0, -30.0) AS b, a.in_area(5.0, -30.0) AS a").iloc[0].tolist() == [
            True, False,
        ]  # fmt: skip
    with Explorer(lake, request="b") as explorer:
        assert explorer.sql("SELECT in_area(5.0, -30.0) AS b").iloc[0].tolist() == [True]


def sealed(values):
    return json.dumps({**values, "digest": digest(values)})


@pytest.mark.parametrize("number", [2, pytest.param(8, marks=pytest.mark.nightly)])
def test_an_unknown_or_damaged_area_is_an_error_of_the_query_only(lake, number):
    publish.make_version(lake, plain_plan(), plain_work, name="a")
    with Explorer(lake) as explorer:
        assert explorer.sql("SELECT count(*) AS n FROM plain").n[0] > 0
        with pytest.raises(BadInput, match="does not record the area"):
            explorer.sql("SELECT in_area(0.0, -30.0)")
    written = {"box": None, "vertices": [], "patches": [], "ra": 10**400, "dec": 0.0, "radius": 1.0, "wide": False}
    texts = {
        "[" * 100_000: "cannot be read", sealed(written): "too large", "[]": "must contain an object",
        "{}": "does not record", "{": "cannot be read", '{"digest": "0"}': "has changed since it was written",
        sealed({}): "cannot be read", sealed({**written, "ra": "inf"}): "is not a finite number",
    }  # fmt: skip
    # Each starts a process. The tests below read the file in this process.
    for text, reason in list(texts.items())[:number]:
        (lake / "names" / "a" / "area.json").write_text(text)
        with Explorer(lake) as explorer, pytest.raises(BadInput, match=reason):
            explorer.sql("SELECT in_area(0.0, -30.0)")
    with pytest.raises(Damaged):
        request_links.read_area(lake, "a") if (lake / "names/a/area.json").write_text("[") else None


@pytest.mark.parametrize("text", ['{"digest": "0", "wide": NaN}', '{"digest": "0", "ra": Infinity}', "3"])
def test_an_area_with_values_that_json_does_not_have_is_damaged(lake, text):
    recorded(lake, "a", AREAS["wide"])
    (lake / "names" / "a" / "area.json").write_text(text)
    with pytest.raises(Damaged, match=r"area\.json"):
        request_links.read_area(lake, "a")


def test_an_area_is_not_a_table(lake):
    recorded(lake, "a", AREAS["wide"])
    assert request_links.tables_of_request(lake, "a") == ["plain"]
    assert request_links.read_area(lake, "a")["wide"] is True
    assert request_links.read_area(lake, "b") is None
