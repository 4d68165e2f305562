"""The Spark session: the lake's tables as views that hold the same rows as every other reader's."""

import duckdb
import numpy as np
import pytest

from jobs.session import session, struct, views
from lake_schema.errors import Damaged
from lake_schema.store import publish, read
from lake_schema.store.plan import Output, Part, Plan
from lake_schema.tables import declared
from tests.universe import CELLS, plain_plan, plain_work, rows_of, toy_plan, toy_work

pytestmark = pytest.mark.spark


def test_every_declared_table_has_a_struct():
    for table in declared(["euclid_vis"]):
        made = struct(table.arrow())
        assert made.names == table.names
        for column in table.columns:
            field = made[column.name]
            assert (field.metadata["unit"], field.metadata["comment"]) == (column.unit, column.doc)
            assert field.nullable == column.nullable


def test_all_readers_give_the_same_rows(spark, lake):
    publish.make(lake, toy_plan(), toy_work)
    publish.make(lake, plain_plan(), plain_work)
    tasks = next(table for table in declared([]) if table.name == "tasks")
    publish.make(lake, Plan(tasks, {}, (Part("0.parquet", {}),)), lambda root, facts: Output(rows_of(tasks, 7)))
    assert views(spark, lake) == ["plain", "tasks", "toy"]
    version = read.version(lake, "toy")
    ours = version.rows().sort_by("id")
    assert spark.table("toy").columns == ours.column_names
    assert spark.table("toy").orderBy("id").toArrow().equals(ours.cast(spark.table("toy").toArrow().schema))
    files = [str(version.path(part)) for part in version.parts]
    theirs = duckdb.sql("SELECT * FROM read_parquet($files) ORDER BY id", params={"files": files}).to_arrow_table()
    assert theirs.select(ours.column_names).cast(ours.schema).equals(ours)
    (row,) = spark.sql("SELECT count(*) AS n, sum(flux) AS s FROM toy WHERE dec > :d", args={"d": -90}).collect()
    assert row.n == sum(n for _, n in CELLS)
    assert row.s == pytest.approx(np.sum(ours["flux"].to_numpy(), dtype=float))
    assert spark.table("tasks").select("cells").first().cells == rows_of(tasks, 7)["cells"][0].as_py()


def test_no_name_of_a_folder_is_a_pattern(spark, tmp_path):
    lake = tmp_path / "a[b]{c,d}*e?"
    publish.make(lake, plain_plan(), plain_work)
    publish.make(tmp_path / "ab{c,d}xef", plain_plan(2), plain_work)
    assert views(spark, lake) == ["plain"]
    assert {row["value"] for row in spark.table("plain").collect()} == {1.0}
    assert spark.table("plain").count() == 60


def test_a_changed_byte_is_found_before_spark_reads_it(spark, lake):
    publish.make(lake, plain_plan(), plain_work)
    path = read.version(lake, "plain").path("1.parquet")
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 4
    path.write_bytes(data)
    with pytest.raises(Damaged, match=r"1\.parquet"):
        views(spark, lake)


def test_there_is_one_session(spark):
    assert session("another").sparkContext is spark.sparkContext
