"""Queries of the archive: limits of time and memory, JSON output, and one-line errors."""

import json
import time

import pyarrow as pa
import pytest

from lake_schema.errors import BadInput, Damaged
from tests.truesky import nightly
from truesky.render import archive

ROWS = pa.table({"path": ["images/a.fits", "images/b.fits"], "seconds": [1.5, None]})
LINE = {"job": "render_exposures", "table": "products", "part": "a", "seconds": 2.0, "peak_gb": 0.5, "attempt": 1}


@nightly.parametrize(
    ("sql", "words"),
    [
        ("SELECT count(*) FROM range(1000000000) a, range(1000000000) b", "memory|stopped after 15 s"),
        ("SELECT repeat('x', 2000000000) FROM products", "memory|stopped after 15 s"),
        ("WITH pg_class AS (SELECT * FROM pg_class) SELECT * FROM pg_class", "is not a table of the lake"),
        ("SELECT * FROM products; DROP VIEW products", "write a"),
        ("SELECT nothing FROM products", "nothing"),
    ],
    (0, 2, 3),
)
def test_invalid_and_endless_queries_are_refused(sql, words):
    started = time.monotonic()
    with pytest.raises(BadInput, match=f"^--sql: SQL: .*({words})") as caught:
        archive.search(ROWS, sql, 512e6, 15.0)
    # The machine may be busy; without a limit the query takes hours.
    assert time.monotonic() - started < 120.0
    assert len(str(caught.value).splitlines()) == 1


def test_values_of_all_types_become_json():
    sql = """SELECT path, seconds, 1.25 AS share, 2::HUGEINT AS many, DATE '2024-02-03' AS day, 'x'::BLOB AS blob,
             [1.5, 2.25]::DECIMAL(4, 2)[] AS list, {'a': 1.5} AS struct, INTERVAL 3 DAY AS span, true AS flag
             FROM products ORDER BY path"""
    first, second = map(json.loads, archive._objects(archive.search(ROWS, sql)))
    assert (first["path"], first["seconds"], first["many"], first["day"]) == ("images/a.fits", 1.5, 2, "2024-02-03")
    assert (float(first["share"]), [float(x) for x in first["list"]]) == (1.25, [1.5, 2.25])
    assert (second["seconds"], second["flag"]) == (None, True)


@pytest.mark.parametrize(
    ("sql", "words"),
    [("SELECT 1 AS a, 2 AS a", "same name"), ("SELECT TIMESTAMP '290000-01-01' AS t", "cannot be written as JSON")],
)
def test_results_without_a_json_form_are_refused(sql, words):
    with pytest.raises(BadInput, match=words):
        archive._objects(archive.search(ROWS, sql))


def logged(lake, *lines):
    path = lake / "runs" / "20240101T000000.000000-products-1.jsonl"
    path.parent.mkdir()
    path.write_bytes(b"\n".join(line if isinstance(line, bytes) else json.dumps(line).encode() for line in lines))
    return path


def test_an_incomplete_last_line_of_a_log_is_ignored(lake):
    failed = {**LINE, "error": "no"}
    for number, cut in enumerate((b'{"part": "b', b"\0\0\0", b"\xff", b"[" * 100_000, b"3", b'{"part": 3}')):
        root = lake / str(number)
        root.mkdir()
        logged(root, {"job": "x", "parts": 2}, failed, cut)
        assert archive.failures(root)["part"].to_pylist() == ["a"]


@pytest.mark.parametrize(
    "line",
    [
        b"\0", b"\xff", b"{", b"3", b"null", b'"part"', b'["part"]', b"[" * 100_000, b'{"part": ["a"]}',
        {**LINE, "error": 3}, {**LINE, "seconds": "2"}, {**LINE, "peak_gb": None}, {**LINE, "attempt": 1.5},
        {**LINE, "seconds": -(2**63)},
    ],
)  # fmt: skip
def test_errors_name_other_damaged_lines(lake, capsys, line):
    path = logged(lake, LINE, line, LINE)
    with pytest.raises(Damaged, match=rf"{path.name} line 2 is not a valid log line"):
        archive.failures(lake)
    assert archive.main(["--lake", str(lake), "--failures"]) == 1
    assert capsys.readouterr().err.count("\n") == 1
