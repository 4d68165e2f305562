"""The Spark session: one, and it reads a lake's files as every other reader does."""

import duckdb
import pytest

from jobs.session import session
from lake_schema.store import publish, read
from tests.universe import CELLS, toy_plan, toy_work

pytestmark = pytest.mark.spark


def test_other_readers_find_the_same_rows(spark, lake):
    publish.make(lake, toy_plan(), toy_work)
    version = read.version(lake, "toy")
    ours, files = version.rows().sort_by("id"), [str(version.path(part)) for part in version.parts]
    toy = spark.read.parquet(*files)
    assert toy.columns == ours.column_names
    assert toy.orderBy("id").toArrow().equals(ours.cast(toy.toArrow().schema))
    theirs = duckdb.sql("SELECT * FROM read_parquet($files) ORDER BY id", params={"files": files}).to_arrow_table()
    assert theirs.select(ours.column_names).cast(ours.schema).equals(ours)
    assert toy.count() == sum(n for _, n in CELLS)


def test_there_is_one_session(spark):
    assert session("another").sparkContext is spark.sparkContext
