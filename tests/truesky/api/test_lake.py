"""A lake opened from Python: tables, queries and errors. Images and truth are tested in tests/test_field.py."""

import inspect
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

import truesky
from lake_schema import errors
from lake_schema.fits import images
from lake_schema.store import publish, read
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.products import PRODUCTS
from tests import requests
from tests.universe import CELLS, plain_plan, plain_work, rows_of, toy_plan, toy_work
from truesky.api.given_frames import GivenFrame, InjectedFrame
from truesky.api.lake_frames import LakeFrame
from truesky.api.sky_images import SkyImage
from truesky.render import models

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def opened(lake):
    publish.make_version(lake, plain_plan(1), plain_work)
    with truesky.open(lake) as found:
        yield found


def test_tables_and_columns_are_listed(opened):
    assert list(opened.tables().index) == ["plain"]
    assert opened.tables().loc["plain", "rows"] == 60
    assert set(opened.table("plain")) == set(opened.columns("plain").index)
    assert "plain" in repr(opened)


def test_a_table_is_read_in_each_form(opened):
    rows = opened.table("plain", into="arrow")
    assert isinstance(rows, pa.Table)
    assert rows.num_rows == 60
    name = rows.column_names[0]
    assert opened.table("plain", [name], into="arrow").column_names == [name]
    assert list(opened.table("plain", into="astropy")[name]) == rows[name].to_pylist()


def test_columns_that_do_not_exist_are_refused_with_suggestions(opened):
    with pytest.raises(truesky.BadInput, match=r"^table plain has no column ID; did you mean id\?$"):
        opened.table("plain", ["ID"])
    with pytest.raises(truesky.BadInput, match=r"^table plain has no column qqqq; it has "):
        opened.cone("plain", 0.0, 0.0, 1.0, columns="qqqq")


def test_tables_are_pandas_unless_another_kind_is_named(lake):
    publish.make_version(lake, toy_plan(), toy_work)
    with truesky.open(lake) as found:
        for ask in (
            lambda **into: found.table("toy", ["id"], **into),
            lambda **into: found.sql("SELECT id FROM toy", **into),
            lambda **into: found.cone("toy", 0.0, 0.0, 180.0, ["id"], **into),
        ):
            assert isinstance(ask(), pd.DataFrame)
            assert sorted(ask()["id"]) == sorted(ask(into="arrow")["id"].to_pylist())


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
    publish.make_version(lake, toy_plan(), toy_work)
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
        (
            lambda lake: lake.hist("plain", "id", range=(0, 1)),
            "hist has no argument range: allowed: table, x, bins, span",
        ),
        (lambda lake: lake.heatmap("plain", "id"), r'y is missing: write lake.heatmap\("galaxies", "ra", "dec"\)'),
        (
            lambda lake: lake.skymap("plain", orders=5),
            r"skymap has no argument orders: did you mean order\? allowed: table, order",
        ),
        (lambda lake: lake.export("few.csv", "SELECT id FROM plain"), r"write lake.export\(query, 'few.csv'\)$"),
        (lambda lake: truesky.run("a.toml", "lake", detector="3-4"), r"no argument detector: did you mean detectors\?"),
        (lambda lake: lake.truth(1), r"^detector is missing: write lake.truth\(exposure_id, detector\); lake.images"),
        (lambda lake: lake.frame(1, ccd="3-4"), "^lake.frame has no argument ccd: allowed: exposure, detector$"),
        (lambda lake: lake.sql(query="SELECT 1"), r'^query is missing: write lake.sql\("SELECT count\(\*\) FROM'),
        (lambda lake: lake.truth(1, "3-4"), "has no table products"),
        (lambda lake: lake.wcs("a.fits"), "has no table products"),
        (lambda lake: lake.extensions("a.fits"), "has no table products"),
        (lambda lake: lake.models(1, "3-4"), "has no table products"),
        (lambda lake: lake.table("plan"), r"has no table plan; did you mean plain\?"),
        (lambda lake: lake.table("plain", into="polars"), "polars"),
        (lambda lake: lake.cone(53.1, -27.8, 0.05, "plain"), "^the table must be a name such as '[a-z]+', got 53.1$"),
        (lambda lake: lake.table("plain", [3]), r"columns = \[3\] is not a name or a list of names"),
    ],
)
def test_missing_tables_and_images_are_named(opened, ask, said):
    with pytest.raises(truesky.BadInput, match=said):
        ask(opened)


def public_functions():
    """Return the functions and methods of users that require an argument."""
    yield from (truesky.Lake.__init__, truesky.check, truesky.run, truesky.frame)
    for owner in (truesky.Lake, LakeFrame, SkyImage, GivenFrame, InjectedFrame, truesky.plots):
        for name, function in inspect.getmembers(owner, inspect.isfunction):
            required = [each for each in inspect.signature(function).parameters.values() if each.default is each.empty]
            names = [each.name for each in required if each.name != "self" and each.kind is not each.VAR_KEYWORD]
            # Only truesky itself calls `attach`.
            if names and not name.startswith("_") and name != "attach":
                yield function


@pytest.mark.parametrize("function", list(public_functions()), ids=lambda function: function.__qualname__)
def test_missing_arguments_are_named_with_a_call(function):
    is_method = "self" in inspect.signature(function).parameters
    with pytest.raises(truesky.BadInput, match=r"(is|are) missing: write (lake|truesky|frame|image)\."):
        function(*([None] if is_method else []))


def test_models_use_the_versions_of_the_open_lake(lake, monkeypatch):
    """Folder and version of the images are passed on, and wrong arguments are refused at the call."""
    rows, calls = Output(rows_of(PRODUCTS, 12)), []

    def published(seed):
        publish.make_version(lake, Plan(PRODUCTS, {"seed": seed}, (Task("0.parquet", {}),)), lambda root, facts: rows)

    published(1)
    monkeypatch.setattr(models, "models", lambda *arguments: iter(calls.append(arguments) or ()))
    with truesky.open(lake) as found:
        published(2)
        assert list(found.models(np.int32(3), "DET22", [np.int64(7)])) == []
        ((root, version, *others),) = calls
        assert (root, version.key, others) == (lake, found.tables().loc["products", "version"], [3, "DET22", [7]])
        assert version.key != read.version(lake, "products").key
        for bad in ({"exposure_id": "x"}, {"exposure_id": 1.5}, {"sources": ["x"]}, {"sources": 3}):
            with pytest.raises(truesky.BadInput, match="number"):
                found.models(**{"exposure_id": 3, "detector": "DET22", **bad})


def test_a_folder_that_is_no_lake_is_refused(tmp_path):
    with pytest.raises(truesky.BadInput, match="nowhere"):
        truesky.open(tmp_path / "nowhere")


@pytest.mark.parametrize("name", ["requests/demo.toml", "none.toml"])
def test_a_request_is_not_a_lake(name):
    remedy = rf'^{name} is a request, not a lake: truesky.run\("{name}", "my_lake"\) makes a lake from it$'
    with pytest.raises(truesky.BadInput, match=remedy):
        truesky.open(name)


def test_all_names_of_the_interface_are_there():
    for name in truesky.__all__:
        assert getattr(truesky, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = truesky.nothing
    assert truesky.Damaged is errors.Damaged
    assert truesky.Image is images.Image
    page = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    assert [name for name in truesky.__all__ if f"truesky.{name}" not in page and name[0] != "_"] == []


def test_importing_truesky_is_quick():
    """The import loads no numerical library."""
    code = "import sys, truesky; print(sorted({'numpy', 'pyarrow', 'pandas', 'numba', 'scipy'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_another_package_called_jobs_does_not_matter(tmp_path):
    """Users may have a package `jobs`, like the folder of our scripts, in the current folder or in $PYTHONPATH."""
    (tmp_path / "jobs").mkdir()
    (tmp_path / "jobs" / "__init__.py").write_text("raise SystemExit('the other package')")
    path = requests.written(tmp_path)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    code = (
        "import sys, truesky; from truesky.commands.__main__ import main; truesky.open, truesky.run\n"
        "assert main(['check', sys.argv[1]]) == 0; main(['build', '--help'])"
    )
    script = str(ROOT / "jobs" / "catalogue" / "build_stars.py")
    for arguments, said in ((["-c", code, str(path)], ": good: "), ([script, "--help"], "REQUEST LAKE")):
        done = subprocess.run(
            [sys.executable, *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True
        )
        assert (done.returncode, done.stderr) == (0, "")
        assert said in done.stdout
