"""The benchmark of the lake with --quick: all figures are present, and files are small."""

import json

import pytest

from benchmarks import lake as benchmark

KEYS = (
    "write_rows_per_s_core", "write_vs_spark_writer", "bytes_per_row", "cone_ms", "cone_vs_lsdb", "heatmap_s",
    "verify_mb_per_s",
)  # fmt: skip


@pytest.mark.spark
@pytest.mark.nightly
def test_the_figures(tmp_path):
    file = tmp_path / "lake.json"
    assert benchmark.main(["--quick", "--json", str(file)]) == 0
    figures = json.loads(file.read_text())
    assert {"name", "commit", "machine", "repeats", *KEYS} <= set(figures)
    assert set(benchmark.NOTES) <= set(figures)
    assert all(value > 0 for key, value in figures.items() if key in benchmark.NOTES)


def test_a_row_is_smaller_than_with_defaults(tmp_path):
    """The size does not depend on the load of the machine. The target is 170 bytes for these 50 columns."""
    import pyarrow.parquet as pq

    from lake_schema.store import parquet

    rows = benchmark.random_rows(benchmark.FIRST_CELL, 100_000)
    assert rows.nbytes == 228 * rows.num_rows
    parquet.write(tmp_path / "ours.parquet", rows, benchmark.TRIAL)
    pq.write_table(rows, tmp_path / "default.parquet")
    ours, default = ((tmp_path / f"{name}.parquet").stat().st_size / rows.num_rows for name in ("ours", "default"))
    assert ours <= 170
    assert default > 1.7 * ours
