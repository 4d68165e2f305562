"""The Spark session: one, and it reads a lake's files as every other reader does."""

import sys
from pathlib import Path
from types import SimpleNamespace

import duckdb
import psutil
import pytest

from lake_schema.store import publish, read
from tests.universe import CELLS, toy_plan, toy_work
from truesky.running.session import get_session, is_alive

pytestmark = pytest.mark.spark


def test_other_readers_find_the_same_rows(spark, lake):
    publish.make_version(lake, toy_plan(), toy_work)
    version = read.version(lake, "toy")
    ours, files = version.rows().sort_by("id"), [str(version.partition_path(part)) for part in version.partitions]
    toy = spark.read.parquet(*files)
    assert toy.columns == ours.column_names
    assert toy.orderBy("id").toArrow().equals(ours.cast(toy.toArrow().schema))
    theirs = duckdb.sql("SELECT * FROM read_parquet($files) ORDER BY id", params={"files": files}).to_arrow_table()
    assert theirs.select(ours.column_names).cast(ours.schema).equals(ours)
    assert toy.count() == sum(n for _, n in CELLS)


def test_nobody_else_can_reach_it(spark):
    """All that its processes listen to is on this machine alone, and they ask each other for a secret."""
    assert spark.range(0, 4, 1, numPartitions=2).mapInArrow(lambda batches: batches, "id long").count() == 4
    processes = psutil.Process().children(recursive=True)
    ends = {end.laddr.ip for p in processes for end in p.net_connections("inet") if end.status == psutil.CONN_LISTEN}
    assert {end.removeprefix("::ffff:") for end in ends} == {"127.0.0.1"}
    # Sockets without an address lie where only their owner may look.
    places = {Path(end.laddr) for p in processes for end in p.net_connections("unix") if end.laddr.endswith(".sock")}
    assert places
    assert {place.parent.stat().st_mode & 0o777 for place in places} == {0o700}
    # Nor do its workers print a traceback where they are dropped.
    assert any("truesky.running.spark_workers" in p.cmdline() for p in processes)
    conf = spark.sparkContext.getConf()
    assert (conf.get("spark.authenticate"), conf.get("spark.ui.enabled")) == ("true", "false")


def test_workers_import_nothing_from_the_current_folder(spark):
    assert spark.sparkContext.parallelize([0], 1).map(lambda _: sys.flags.safe_path).collect() == [True]


def test_there_is_one_session(spark):
    assert get_session("another").sparkContext is spark.sparkContext


@pytest.mark.parametrize("stopped_in", ["Python", "Java"])
def test_a_stopped_session_is_not_alive(stopped_in):
    """PySpark's `stop` removes the reference to the Java context."""
    stopped = SimpleNamespace(sc=lambda: SimpleNamespace(isStopped=lambda: True))
    java_context = None if stopped_in == "Python" else stopped
    assert not is_alive(SimpleNamespace(sparkContext=SimpleNamespace(_jsc=java_context)))


def test_the_session_of_the_tests_is_alive(spark):
    assert is_alive(spark)
