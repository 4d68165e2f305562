"""Parquet files that take too much memory are refused, and the end of a process waits for threads that read them."""

import hashlib
import threading
import time

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lake_schema.columns import Column, Table
from lake_schema.errors import BadInput, Damaged
from lake_schema.store import blocks, manifest, parquet, publish, read
from lake_schema.store.plan import Output, Plan, Task

TEXTS = Table(
    "texts",
    1,
    (
        Column("id", "int64", lo=0, doc="identifier"),
        Column("value", "float64", doc="value"),
        Column("name", "string", doc="name"),
        Column("samples", "list<float32>", doc="samples"),
    ),
    "A toy table with texts and lists.",
)


def texts_of(n, length):
    columns = {"id": range(n), "value": [1.0] * n, "name": ["x" * length] * n, "samples": [[0.5, 1.5]] * n}
    return TEXTS.build(columns)


@pytest.fixture
def texts(lake):
    """A version with 1.6 MB of numbers and 20 MB of texts in a few kB."""
    plan = Plan(TEXTS, {"seed": 1}, (Task("0.parquet", {}),))
    rows = texts_of(70_000, 300)
    publish.make_version(lake, plan, lambda root, facts: Output(rows))
    version = read.version(lake, "texts")
    assert sum(entry["bytes"] for entry in version.manifest["files"]) < 300_000
    assert version.rows().equals(rows)
    return version


def test_a_file_with_many_equal_numbers_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "0.parquet"
    rows = pa.table({"value": np.ones(1_000_000)})
    pq.write_table(rows, path)
    assert path.stat().st_size < 10_000
    entry = {"path": path.name, **blocks.file_checksums(path, [4])}
    assert parquet.read(tmp_path, entry).equals(rows)
    monkeypatch.setattr(parquet, "MAX_DECODED_BYTES", 7_000_000)
    words = r"0\.parquet needs 0\.008 GB of memory, more than the limit of 0\.007 GB"
    with pytest.raises(Damaged, match=words):
        parquet.open_dataset(tmp_path, [entry], rows.schema)
    with pytest.raises(Damaged, match=words):
        parquet.read(tmp_path, entry)
    with pytest.raises(BadInput, match=words):
        manifest.file_entry(path, path.name)


def test_large_lists_and_numbers_are_refused(texts, monkeypatch):
    # 8 bytes each for id and value, and two samples of 4 bytes.
    monkeypatch.setattr(parquet, "MAX_DECODED_BYTES", 24 * 70_000)
    assert texts.rows(["samples"]).num_rows == 70_000
    monkeypatch.setattr(parquet, "MAX_DECODED_BYTES", 24 * 70_000 - 1)
    with pytest.raises(Damaged, match=r"0\.parquet needs 0\.00168 GB"):
        texts.rows(["samples"])
    assert "needs 0.00168 GB of memory" in read.find_faults(texts, deep=True)[0]


def test_large_texts_are_refused_if_they_are_requested(texts, monkeypatch):
    monkeypatch.setattr(parquet, "_MIN_MEASURED_BYTES", 0)
    monkeypatch.setattr(parquet, "MAX_DECODED_BYTES", 300 * 70_000)
    assert texts.rows().num_rows == 70_000
    monkeypatch.setattr(parquet, "MAX_DECODED_BYTES", 300 * 70_000 - 1)
    assert texts.rows(["id", "value"]).num_rows == 70_000
    with pytest.raises(Damaged, match=r"0\.parquet needs 0\.021 GB of memory"):
        texts.rows()
    with pytest.raises(Damaged, match=r"0\.parquet needs 0\.021 GB of memory"):
        texts.read_sidecar("dataset/0.parquet")


def test_large_rows_are_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr(parquet, "MAX_DECODED_BYTES", 1_000_000)
    with pytest.raises(BadInput, match=r"^table texts: 10000 rows of one file need 0\.\d+ GB"):
        parquet.write(tmp_path / "0.parquet", texts_of(10_000, 100), TEXTS)
    assert list(tmp_path.iterdir()) == []


def compute_until(stop):
    while not stop.is_set():
        # Hashing a large buffer releases the interpreter, as a thread of Arrow does.
        hashlib.sha256(bytes(1 << 22)).digest()


def test_the_end_waits_for_a_running_thread():
    stop = threading.Event()
    thread = threading.Thread(target=compute_until, args=(stop,))
    thread.start()
    threading.Timer(0.2, stop.set).start()
    parquet._wait_for_threads()
    assert stop.is_set()
    thread.join(10.0)
    assert not thread.is_alive()


def test_the_end_does_not_wait_for_ever(monkeypatch):
    monkeypatch.setattr(parquet, "_LONGEST_WAIT_S", 0.05)
    stop = threading.Event()
    thread = threading.Thread(target=compute_until, args=(stop,))
    thread.start()
    start = time.monotonic()
    parquet._wait_for_threads()
    waited = time.monotonic() - start
    stop.set()
    thread.join(10.0)
    assert 0.05 <= waited < 5.0
