"""A lake opened from Python: tables, queries and what is refused; images and truth in tests/test_field.py."""

import subprocess
import sys

import numpy as np
import pyarrow as pa
import pytest

import truesky
from lake_schema.store import publish
from tests.universe import CELLS, plain_plan, plain_work, toy_plan, toy_work


@pytest.fixture
def opened(lake):
    publish.make(lake, plain_plan(1), plain_work)
    with truesky.open(lake) as found:
        yield found


def test_tables_and_columns_are_listed(opened):
    assert list(opened.tables().index) == ["plain"]
    assert opened.tables().loc["plain", "rows"] == 60
    assert set(opened.table("plain").column_names) == set(opened.columns("plain").index)
    assert "plain" in repr(opened)


def test_a_table_is_read_in_each_form(opened):
    rows = opened.table("plain")
    assert isinstance(rows, pa.Table)
    assert rows.num_rows == 60
    name = rows.column_names[0]
    assert opened.table("plain", [name]).column_names == [name]
    assert opened.table("plain", into="pandas")[name].tolist() == rows[name].to_pylist()
    assert list(opened.table("plain", into="astropy")[name]) == rows[name].to_pylist()


def test_a_query_takes_parameters(opened):
    found = opened.sql("SELECT count(*) AS n FROM plain WHERE $low < 2", low=1)
    assert found["n"].tolist() == [60]
    assert opened.sql("SELECT 1 AS one", into="arrow")["one"].to_pylist() == [1]


def test_rows_are_counted_in_bins(opened):
    ids = opened.table("plain")["id"].to_numpy()
    counts, edges = opened.hist("plain", "id", 6, (0.0, 60.0))
    assert counts.tolist() == np.histogram(ids, edges)[0].tolist()
    counts, _ = opened.hist("plain", "id", 6, (0.0, 60.0), where="id < 20", weight="0.5")
    assert counts.sum() == 10.0
    counts, x, y = opened.heatmap("plain", "id", "id / 2", (3, 2), ((0.0, 60.0), (0.0, 30.0)))
    assert counts.tolist() == np.histogram2d(ids, ids / 2, (x, y))[0].T.tolist()


def test_a_catalogue_is_counted_on_the_sky(lake):
    publish.make(lake, toy_plan(), toy_work)
    with truesky.open(lake) as found:
        cells, counts = found.skymap("toy", order=5)
    assert dict(zip(cells.tolist(), counts.tolist(), strict=True)) == {cell: n for cell, n in CELLS if n}


def test_the_result_of_a_query_is_written(opened, tmp_path):
    path = opened.export("SELECT id FROM plain WHERE id < $most ORDER BY id", tmp_path / "few.csv", most=3)
    assert path.read_text().split() == ['"id"', "0", "1", "2"]


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda lake: lake.table("galaxies"), "has no table galaxies; it has plain"),
        (lambda lake: lake.sql("DELETE FROM plain"), "DELETE"),
        (lambda lake: lake.images(), "has no table products"),
        (lambda lake: lake.truth(1, "3-4"), "has no table products"),
        (lambda lake: lake.wcs("a.fits"), "has no table products"),
        (lambda lake: lake.extensions("a.fits"), "has no table products"),
        (lambda lake: lake.models(1, "3-4"), "has no table products"),
        (lambda lake: lake.table("plain", into="polars"), "polars"),
    ],
)
def test_what_a_lake_has_not_is_named(opened, ask, said):
    with pytest.raises(truesky.BadInput, match=said):
        ask(opened)


def test_a_folder_that_is_no_lake_is_refused(tmp_path):
    with pytest.raises(truesky.BadInput, match="nowhere"):
        truesky.open(tmp_path / "nowhere")


def test_all_names_of_the_interface_are_there():
    for name in truesky.__all__:
        assert getattr(truesky, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = truesky.nothing


def test_importing_truesky_is_quick():
    """It loads no numerical library before one is needed."""
    code = "import sys, truesky; print(sorted({'numpy', 'pyarrow', 'pandas', 'numba', 'scipy'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_another_package_called_jobs_does_not_matter(tmp_path):
    """The names of our own scripts' folder is free for users."""
    (tmp_path / "jobs").mkdir()
    (tmp_path / "jobs" / "__init__.py").write_text("raise SystemExit('the user\\'s own')")
    code = "import truesky; print(truesky.open.__name__, truesky.check.__name__)"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout == "Lake check\n"
    help_text = subprocess.run(
        [sys.executable, "-m", "truesky.commands", "build", "--help"], cwd=tmp_path, capture_output=True, text=True
    )
    assert (help_text.returncode, help_text.stderr) == (0, "")
