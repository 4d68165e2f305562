"""Downloads in every format contain the same rows, or fail completely."""

import csv
import http.client
import io
import itertools
import json
from urllib.parse import quote

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from astropy.io.votable import parse_single_table
from astropy.table import Table

from lake_schema.errors import BadInput
from lake_schema.store import read
from truesky.explore import results

# The fluxes of every third row are missing.
QUERY = """SELECT id, ra, z_obs, CASE WHEN id % 3 > 0 THEN flux_halpha END AS flux, kind, 'a,"<&>' || kind AS name
           FROM galaxies ORDER BY id LIMIT 700"""


def test_all_formats_contain_the_same_rows(page, shown):
    files = {}
    for form in ("csv", "parquet", "vot", "fits"):
        status, _, files[form] = page.of_lake(f"export?format={form}&sql={quote(QUERY)}")
        assert status == 200
    stored = (
        read.version(shown, "galaxies").rows(["id", "ra", "z_obs", "flux_halpha", "kind"]).sort_by("id").slice(0, 700)
    )
    parquet = pq.read_table(pa.BufferReader(files["parquet"]))
    vot, fits = (
        parse_single_table(io.BytesIO(files["vot"])).to_table(),
        Table.read(io.BytesIO(files["fits"]), format="fits"),
    )
    text = list(csv.DictReader(io.StringIO(files["csv"].decode())))
    for name in ("id", "ra", "z_obs", "kind"):
        expected = stored[name].to_numpy()
        np.testing.assert_array_equal(parquet[name].to_numpy(), expected)
        np.testing.assert_array_equal(np.asarray(vot[name]), expected)
        np.testing.assert_array_equal(np.asarray(fits[name]), expected)
        np.testing.assert_array_equal(np.array([row[name] for row in text]).astype(expected.dtype), expected)
    missing = (stored["id"].to_numpy() % 3 == 0) | stored["flux_halpha"].is_null().to_numpy()
    flux = stored["flux_halpha"].to_numpy()[~missing]
    assert 100 < missing.sum() < 600
    in_text = np.array([row["flux"] or "nan" for row in text]).astype(np.float32)
    in_fits = np.ma.filled(np.ma.asarray(fits["flux"]), np.nan)
    in_vot = np.ma.filled(np.ma.asarray(vot["flux"]), np.nan)
    for own in (parquet["flux"].to_numpy(), in_vot, in_fits, in_text):
        np.testing.assert_array_equal(np.isnan(own), missing)
        np.testing.assert_array_equal(own[~missing], flux)
    assert parquet["flux"].is_null().to_numpy().tolist() == missing.tolist()
    names = [f'a,"<&>{kind}' for kind in stored["kind"].to_pylist()]
    assert (
        parquet["name"].to_pylist()
        == list(vot["name"])
        == [n.strip() for n in fits["name"]]
        == [r["name"] for r in text]
        == names
    )
    assert str(vot["ra"].unit) == str(fits["ra"].unit) == parquet.schema.field("ra").metadata[b"unit"].decode() == "deg"


@pytest.mark.parametrize("form", ["csv", "parquet", "vot", "fits"])
@pytest.mark.parametrize(
    "sql", ["SELECT nothing FROM galaxies", "SELECT 1 AS a, 2 AS a", "SELECT * FROM '/etc/passwd'"]
)
def test_an_error_gives_no_file(page, form, sql):
    status, headers, body = page.of_lake(f"export?format={form}&sql={quote(sql)}")
    assert status == 400
    assert "Content-Disposition" not in headers
    assert json.loads(body)["error"]


def test_a_late_error_aborts_the_download(page, monkeypatch):
    """If rows fail after the first pieces were sent, the connection ends without the last chunk.

    The error is raised here, because the database reads ahead and may find an error of a late row before the first one
    is sent.
    """
    stream = results.stream_file

    def fail_after_two_pieces(batches, ending):
        yield from itertools.islice(stream(batches, ending), 2)
        raise BadInput("a late row")

    with monkeypatch.context() as patch:
        patch.setattr(results, "stream_file", fail_after_two_pieces)
        with pytest.raises((http.client.IncompleteRead, ConnectionError)):
            page.of_lake(f"export?format=csv&sql={quote('SELECT range AS a FROM range(1000000)')}")
    assert page.of_lake("export?format=csv&sql=SELECT+1+AS+a")[2] == b'"a"\n1\n'


@pytest.mark.parametrize(
    "sql",
    [
        "SELECT repeat('x', 1000000) AS a FROM range(1000)",
        # In FITS the short ones take as much as the long one.
        "SELECT CASE WHEN range = 7 THEN repeat('x', 1000000) ELSE 'y' END AS a FROM range(1000)",
    ],
)
def test_temporary_files_have_a_limited_size(page, sql, monkeypatch):
    monkeypatch.setattr(results, "MAX_FITS_BYTES", 1 << 25)
    status, _, body = page.of_lake(f"export?format=fits&sql={quote(sql)}")
    assert status == 400
    assert "GB: ask for less" in json.loads(body)["error"]


@pytest.mark.parametrize("number", [300_000, pytest.param(3_000_000, marks=pytest.mark.nightly)])
def test_fits_of_more_rows_than_fit_into_memory(page, number):
    """The header of a file of many pieces has the number of rows, and the last row is complete."""
    sql = f"SELECT range AS id, range * 0.5 AS x, 'n' || range AS name FROM range({number})"
    status, headers, body = page.of_lake(f"export?format=fits&sql={quote(sql)}")
    assert (status, headers["Content-Type"]) == (200, "application/fits")
    assert len(body) % 2880 == 0
    rows = Table.read(io.BytesIO(body), format="fits")
    assert len(rows) == number
    np.testing.assert_array_equal(rows["id"], np.arange(number))
    assert (rows["x"][-1], rows["name"][-1]) == (0.5 * (number - 1), f"n{number - 1}")


def test_pieces_of_wide_rows_are_small(page):
    """A table of a thousand rows of one megabyte is never in memory as a whole."""
    process = page.server.lake.explorer.process()
    try:
        sizes = [batch.nbytes for batch in process.batches("SELECT repeat('x', 1000000) AS a FROM range(50)")]
        assert sum(sizes) >= 50e6
        assert max(sizes) <= 8 << 20
        with pytest.raises(BadInput, match="64 MB"):
            list(process.batches("SELECT repeat('x', 70000000) AS a"))
    finally:
        process.close()
