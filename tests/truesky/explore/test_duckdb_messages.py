"""Messages of DuckDB as plain sentences."""

import re

import duckdb
import pytest

from lake_schema.errors import BadInput
from truesky.explore.duckdb_messages import plain_message


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("SELECT kind, count(*) FROM t", "column kind must be in GROUP BY, or in an aggregate function such as"),
        ("SELECT kind FROM t HAVING n > 1", "column n must be in GROUP BY, or in an aggregate function such as"),
        (
            "SELECT n FROM t WHERE avg(n) > 1",
            "WHERE cannot contain aggregate functions such as avg: write .* in HAVING",
        ),
        ("SELECT n FROM t WHERE row_number() OVER () > 1", "WHERE cannot contain window functions: .* in QUALIFY"),
        ("SELECT stdev(n) FROM t", r"function stdev does not exist; did you mean stddev\?$"),
        ("SELECT qqqqqqqq(n) FROM t", "function qqqqqqqq does not exist$"),
        ("SELECT 'high'::FLOAT", "'high' is text where a number is required$"),
        ("SELECT x.n FROM t", "FROM has no table or alias x; it has t$"),
        ("SELECT sum(kind) FROM t", "sum does not accept arguments of type VARCHAR$"),
        ("SELECT twice()", r"write twice\(x\) for twice$"),
        ("SELECT n frm t", "syntax error near t$"),
        ("SELECT n FROM t LIMIT -1", r"LIMIT/OFFSET cannot be negative \(near -1\)$"),
        ("SELECT avg(sum(n)) FROM t", r"aggregate function calls cannot be nested \(near sum\(n\)\)$"),
    ],
)
def test_sentences(query, message):
    with duckdb.connect() as database:
        database.execute("CREATE TABLE t (n INTEGER, kind VARCHAR)")
        database.execute("CREATE MACRO twice(x) AS 2 * x")
        with pytest.raises(duckdb.Error) as error:
            database.execute(query).fetchall()
    text = plain_message(str(error.value))
    assert re.match(message, text), text
    assert "Error" not in text
    assert "\n" not in text


def test_other_messages_are_unchanged():
    assert plain_message("no such thing") == "no such thing"


@pytest.mark.parametrize(
    ("query", "words"),
    [
        (
            "SELECT DISTINCT TOP 10 id FROM galaxies",
            "^SQL: TOP is possible only in TAP queries: write LIMIT 10 at the end",
        ),
        ("SELECT POINT('ICRS', ra, dec) FROM galaxies", "^SQL: the function POINT is .* TAP .*separation.*in_area"),
        ("SELECT id FROM galaxies WHERE ra > 'high'", "^SQL: 'high' is text where a number is required$"),
        ("DELETE FROM galaxies", "^SQL: DELETE is not possible: write a SELECT, because the tables can only be read$"),
        ("SELECT 1; SELECT 2", r"^SQL: the text contains 2 statements \(SELECT, SELECT\): write a single SELECT$"),
        (" ", "^SQL: the query is empty: write a single SELECT$"),
    ],
)
def test_queries(explorer, query, words):
    with pytest.raises(BadInput, match=words):
        explorer.sql(query)
