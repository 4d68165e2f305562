"""Translation of ADQL to DuckDB's SQL: differences are translated, quotes stay, and errors name unsupported terms."""

import contextlib

import duckdb
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lake_schema import sky
from lake_schema.errors import BadInput
from truesky.explore import adql, session


@pytest.fixture(scope="module")
def database():
    with duckdb.connect() as opened:
        for macro in (*session._MACROS, *adql.MACROS):
            opened.execute(macro)
        yield opened


@pytest.mark.parametrize(
    ("query", "sql"),
    [
        ("SELECT 1", "SELECT 1"),
        ("SELECT TOP 3 a FROM t", "SELECT a FROM t LIMIT 3"),
        ("select distinct top 3 a FROM t ORDER BY a;", "select distinct a FROM t ORDER BY a LIMIT 3"),
        ("SELECT TOP 3 a FROM t OFFSET 5", "SELECT a FROM t LIMIT 3 OFFSET 5"),
        ("SELECT * FROM (SELECT TOP 2 a FROM t) AS s", "SELECT * FROM (SELECT a FROM t LIMIT 2 ) AS s"),
        ("SELECT TOP 1 (SELECT TOP 2 b FROM u) FROM t", "SELECT (SELECT b FROM u LIMIT 2 ) FROM t LIMIT 1"),
        ("SELECT 'TOP 3', \"POINT\" -- TOP 2\nFROM t", "SELECT 'TOP 3', \"POINT\" FROM t"),
        ('SELECT LOG(a), LOG10(a), "LOG"(a), log FROM t', 'SELECT ln(a), LOG10(a), "LOG"(a), log FROM t'),
        ("SELECT top FROM t", "SELECT top FROM t"),
        ("SELECT/* all */a/**/FROM/**/t", "SELECT a FROM t"),
        ("SELECT a FROM t UNION SELECT TOP 5 b FROM u", "SELECT a FROM t UNION ( SELECT b FROM u LIMIT 5)"),
        (
            "SELECT TOP 2 a FROM t UNION ALL SELECT TOP 5 b FROM u ORDER BY 1 OFFSET 1",
            "( SELECT a FROM t LIMIT 2) UNION ALL ( SELECT b FROM u LIMIT 5) ORDER BY 1 OFFSET 1",
        ),
        (
            "SELECT TOP 1 a FROM t WHERE a IN (SELECT b FROM u EXCEPT SELECT TOP 2 c FROM v) ORDER BY a",
            "SELECT a FROM t WHERE a IN (SELECT b FROM u EXCEPT ( SELECT c FROM v LIMIT 2)) ORDER BY a LIMIT 1",
        ),
    ],
)
def test_to_sql(query, sql):
    def spaced(text):
        return text.replace("(", "( ").replace(")", " ) ").split()

    assert spaced(adql.to_sql(query)) == spaced(sql)


def test_top_limits_its_part_of_a_union(database):
    numbers = "SELECT n FROM (VALUES (1), (2), (3)) AS t(n)"
    first, both = (
        numbers.replace("SELECT n", "SELECT TOP 1 n") + f" UNION ALL {numbers}",
        f"{numbers} UNION ALL {numbers}".replace("SELECT n", "SELECT TOP 1 n"),
    )
    last = f"{numbers} UNION ALL " + numbers.replace("SELECT n", "SELECT TOP 1 n") + " ORDER BY n DESC"
    assert [len(database.execute(adql.to_sql(query)).fetchall()) for query in (first, both, last)] == [4, 2, 4]


CONE = "CONTAINS(POINT('ICRS', {0}ra, {0}dec), CIRCLE('ICRS', 40, -30, 3)) = 1"


@pytest.mark.parametrize(
    ("query", "column"),
    [
        (f"SELECT x FROM t WHERE {CONE.format('')}", "_healpix_29"),
        (f"SELECT x FROM t AS s WHERE x > 1 AND ({CONE.format('s.')} OR x < 0) ORDER BY x", "s._healpix_29"),
        (f"SELECT x FROM demo.t WHERE NOT {CONE.format('')}", "_healpix_29"),
        ("SELECT x FROM t WHERE 1 = CONTAINS(POINT(ra, dec), CIRCLE(POINT(40, -30), 3)) LIMIT 9", "_healpix_29"),
        ("SELECT x FROM t WHERE INTERSECTS(CIRCLE(40, - 30, 3), POINT(RA, Dec)) = 1 AND true", "_healpix_29"),
        (f"SELECT t.x FROM t JOIN u ON t.x = u.x AND {CONE.format('t.')}", "t._healpix_29"),
        (f"SELECT t.x FROM t LEFT JOIN u USING (x) WHERE {CONE.format('t.')}", "t._healpix_29"),
        (f"SELECT x FROM (SELECT * FROM t AS own WHERE {CONE.format('own.')}) AS s WHERE x > 2", "own._healpix_29"),
    ],
)
def test_a_cone_has_ranges_of_cells(database, query, column):
    """The rows stay the same, and a scan that uses only the ranges reads fewer."""
    rng = np.random.default_rng(4)
    ra, dec = rng.uniform(30, 50, 4000), rng.uniform(-40, -20, 4000)
    rows = pa.table({"x": np.arange(4000), "ra": ra, "dec": dec, "_healpix_29": sky.healpix_29(ra, dec)})
    other = pa.table({"x": np.arange(0, 4000, 3)})
    found, plain = adql.to_sql(query, {"t", "demo.t"}), adql.to_sql(query)
    assert f"({column} >= " in found
    assert "_healpix_29" not in plain
    with database.cursor() as session_:
        session_.register("t", rows)
        session_.register("u", other)
        answers = [sorted(session_.sql(text.replace("demo.t", "t")).fetchall()) for text in (found, plain)]
    assert answers[0] == answers[1]
    assert 8 < len(answers[0]) < 4000


@pytest.mark.parametrize(
    "query",
    [
        # Not a catalogue, an ambiguous table, a name that hides one, columns of another name.
        f"SELECT x FROM u WHERE {CONE.format('')}",
        f"SELECT x FROM t, u WHERE {CONE.format('')}",
        f"SELECT x FROM t JOIN u USING (x) WHERE {CONE.format('')}",
        f"SELECT x FROM t JOIN u AS s USING (x) WHERE {CONE.format('s.')}",
        f"WITH t AS (SELECT 1 AS x, 2 AS ra, 3 AS dec) SELECT x FROM t WHERE {CONE.format('')}",
        f"SELECT x FROM (SELECT 1 AS ra, 2 AS dec FROM t) AS t WHERE {CONE.format('t.')}",
        f"SELECT x FROM t AS s(ra, dec) WHERE {CONE.format('s.')}",
        "SELECT x FROM t WHERE CONTAINS(POINT(ra_true, dec), CIRCLE(40, -30, 3)) = 1",
        "SELECT x FROM t WHERE CONTAINS(POINT(ra, dec_true), CIRCLE(40, -30, 3)) = 1",
        "SELECT x FROM t WHERE CONTAINS(POINT(dec, ra), CIRCLE(40, -30, 3)) = 1",
        "SELECT x FROM t WHERE CONTAINS(POINT(ra, dec), CIRCLE(40, -30, x)) = 1",
        "SELECT x FROM t WHERE CONTAINS(POINT(ra, dec), CIRCLE(40, -30, 90)) = 1",
        # The comparison is not a complete condition.
        f"SELECT {CONE.format('')} FROM t",
        f"SELECT x FROM t WHERE {CONE.format('')} + 1",
        f"SELECT x FROM t WHERE 1 + {CONE.format('')}",
        f"SELECT x FROM t GROUP BY x, ra, dec HAVING {CONE.format('')}",
        "SELECT x FROM t WHERE CONTAINS(POINT(ra, dec), CIRCLE(40, -30, 3)) = 0",
        "SELECT x FROM t WHERE CONTAINS(POINT(ra, dec), CIRCLE(40, -30, 3)) < 1",
        "SELECT x FROM t WHERE DISTANCE(POINT(ra, dec), POINT(40, -30)) = 1",
    ],
)
def test_no_cell_ranges_without_known_index(query):
    assert adql.to_sql(query, {"t"}) == adql.to_sql(query)


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("SELECT BOX('', 1, 2, 3, 4) FROM t", "BOX is not possible"),
        ("SELECT POINT(1, 2) FROM t", "POINT is not possible alone"),
        ("SELECT CONTAINS(POINT(1, 2)) FROM t", "requires 2 arguments, got 1"),
        ("SELECT CONTAINS(POINT(1, 2), CIRCLE(1, 2)) FROM t", "two coordinates and a radius"),
        ("SELECT CONTAINS(POINT(1), CIRCLE(1, 2, 3)) FROM t", "two coordinates"),
        ("SELECT CONTAINS(CIRCLE(1, 2, 3), POINT(1, 2)) FROM t", "requires a POINT"),
        ("SELECT CONTAINS(POINT(1, 2), POLYGON(1, 2, 3, 4)) FROM t", "three corners"),
        ("SELECT CONTAINS(POINT(1, 2), REGION('x')) FROM t", "REGION is not possible"),
        ("SELECT DISTANCE(POINT(1, 2) FROM t", "bracket is not closed"),
        ("SELECT DISTANCE(, ) FROM t", "requires a POINT"),
        ("SELECT " + "x" * 60_000, "at most"),
    ],
)
def test_refusals(query, words):
    with pytest.raises(BadInput, match=words):
        adql.to_sql(query)


def value(database, expression):
    return database.sql(adql.to_sql(f"SELECT {expression} AS a")).fetchall()[0][0]


def test_polygons(database):
    square = "POLYGON(10, -5, 20, -5, 20, 5, 10, 5)"
    for ra, dec, inside in ((15, 0, 1), (10.1, 4.9, 1), (9.9, 0, 0), (15, 5.2, 0), (195, 0, 0), (375, 0, 1)):
        assert value(database, f"CONTAINS(POINT({ra}, {dec}), {square})") == inside
        text = "'POLYGON ICRS 10 -5 20 -5 20 5 10 5'"
        assert value(database, f"CONTAINS(POINT({ra}, {dec}), ({text}))") == inside
    assert value(database, "CONTAINS(POINT(0.5, 0), POLYGON('ICRS', 359, -1, 1, -1, 1, 1, 359, 1))") == 1


def test_a_polygon_with_a_notch(database):
    # The polygon is an L whose corner at 15, 0 points inwards.
    corners = "10, -5, 20, -5, 20, 0, 15, 0, 15, 5, 10, 5"
    back = "10, 5, 15, 5, 15, 0, 20, 0, 20, -5, 10, -5"
    for ra, dec, inside in ((12, 3, 1), (18, -3, 1), (12, -3, 1), (18, 3, 0), (9, 0, 0), (21, -3, 0), (192, -3, 0)):
        for polygon in (corners, back):
            assert value(database, f"CONTAINS(POINT({ra}, {dec}), POLYGON({polygon}))") == inside


@pytest.mark.parametrize("step", [3, pytest.param(1, marks=pytest.mark.nightly)])
def test_circles_that_meet_polygons(database, step):
    square, text = "POLYGON(10, -5, 20, -5, 20, 5, 10, 5)", "('POLYGON ICRS 10 -5 20 -5 20 5 10 5')"
    for ra, dec, radius, meets in (
        (15, 0, 0.1, 1), (9, 0, 0.9, 0), (9, 0, 1.1, 1), (9, -6, 1.3, 0), (9, -6, 1.5, 1), (15, 7, 1.9, 0),
        (15, 7, 2.1, 1), (195, 0, 3, 0), (40, 30, 60, 1), (22, 0, 1.99, 0), (22, 0, 2.01, 1),
    ):  # fmt: skip
        circle = f"CIRCLE('ICRS', {ra}, {dec}, {radius})"
        # The first and the last of them, or all.
        pairs = [pair for region in (square, text) for pair in ((circle, region), (region, circle))][::step]
        asked = ", ".join(f"INTERSECTS({first}, {second}) AS a{k}" for k, (first, second) in enumerate(pairs))
        assert database.sql(adql.to_sql(f"SELECT {asked}")).fetchall() == [(meets,) * len(pairs)]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=15)
@given(
    st.floats(0, 360), st.floats(-89, 89), st.floats(0.01, 5), st.floats(0, 6.28), st.floats(0, 0.9) | st.floats(1.1, 2)
)
def test_regular_polygons(database, ra, dec, radius, angle, share):
    """Positions clearly inside or outside are classified correctly."""

    def beside(turn, r):
        d, b = np.radians(r), np.radians(dec)
        lat = np.arcsin(np.sin(b) * np.cos(d) + np.cos(b) * np.sin(d) * np.cos(turn))
        lon = np.arctan2(np.sin(turn) * np.sin(d) * np.cos(b), np.cos(d) - np.sin(b) * np.sin(lat))
        return float(ra + np.degrees(lon)), float(np.degrees(lat))

    corners = [beside(turn, radius) for turn in np.linspace(0, 2 * np.pi, 12, endpoint=False)]
    polygon = ", ".join(f"{a!r}, {d!r}" for a, d in corners)
    point = beside(angle, share * radius)
    found = value(database, f"CONTAINS(POINT({point[0]!r}, {point[1]!r}), POLYGON({polygon}))")
    assert found == int(share < 1)


@given(st.text(max_size=60))
def test_any_text_is_translated_or_refused(text):
    with contextlib.suppress(BadInput):
        assert isinstance(adql.to_sql(text), str)
