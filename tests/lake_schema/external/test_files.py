"""Parquet files of other programs are read correctly or refused in one line, with little time and memory."""

import base64
import pickle
import time
import zlib

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lake_schema.errors import BadInput
from lake_schema.external import files as external_files
from lake_schema.store import blocks, parquet

GOOD = pa.table({"ra": np.linspace(0, 359, 1000), "name": ["a", "b"] * 500, "flag": [True, False] * 500})
# Wall time (s) after which a reader hangs. The reading process has a separate limit of CPU time.
HANGS, MOST_BYTES = 120.0, 512 << 20


def read(path, columns=("ra",)):
    """Return the rows; check the limits of time and memory."""
    pool = pa.default_memory_pool()
    before, started = pool.max_memory(), time.perf_counter()
    try:
        return pa.Table.from_batches(external_files.read_batches(path, columns))
    finally:
        assert time.perf_counter() - started < HANGS
        assert pool.max_memory() <= max(before, MOST_BYTES)


def write(path, table, **options):
    pq.write_table(table, path, **options)


def nested(depth, make):
    kind = pa.int32()
    for _ in range(depth):
        kind = make(kind)
    return pa.table({"ra": pa.nulls(3, kind)})


def columns_without_end(path):
    names = [f"c{i}" for i in range(20_000)]
    write(path, pa.table([pa.nulls(1, pa.int8())] * len(names), names=names))


def groups_without_end(path):
    write(path, GOOD.slice(0, 6000).select(["ra"]).combine_chunks(), row_group_size=1)
    write(path, pa.table({"ra": np.zeros(6000)}), row_group_size=1)


def long_texts(path):
    write(path, pa.table({"ra": pa.array(["x" * (4 << 20)] * 30)}))


def many_texts(path):
    write(path, pa.table({"ra": pa.array([f"{i:01000d}" for i in range(5000)])}))


def zeros(path):
    write(
        path,
        pa.table({"ra": np.zeros(40_000_000)}),
        compression="zstd",
        use_dictionary=False,
        row_group_size=40_000_000,
    )


def footer(change):
    def make(path):
        write(path, GOOD)
        data = path.read_bytes()
        path.write_bytes(change(data))

    return make


def lying_length(value):
    return footer(lambda data: data[:-8] + value.to_bytes(4, "little") + b"PAR1")


BAD = {
    "empty": lambda path: path.write_bytes(b""),
    "magic only": lambda path: path.write_bytes(b"PAR1"),
    "twice the magic": lambda path: path.write_bytes(b"PAR1PAR1"),
    "text": lambda path: path.write_text("ra,dec\n1,2\n" * 100),
    "encrypted": footer(lambda data: b"PARE" + data[4:-4] + b"PARE"),
    "no end": footer(lambda data: data[:-1]),
    "half": footer(lambda data: data[: len(data) // 2]),
    "no beginning": footer(lambda data: data[4:]),
    "footer of 0": lying_length(0),
    "footer of 4 GB": lying_length(2**32 - 1),
    "footer of the whole file": footer(lambda data: data[:-8] + (len(data) - 12).to_bytes(4, "little") + b"PAR1"),
    "footer of noise": footer(lambda data: data[:-1000] + bytes(range(256)) * 4 + data[-32:]),
    "compressed whole": footer(lambda data: zlib.compress(data)),
    "columns without end": columns_without_end,
    "groups without end": groups_without_end,
    "nested structs": lambda path: write(path, nested(1000, lambda kind: pa.struct([("a", kind)]))),
    "nested lists": lambda path: write(path, nested(400, pa.list_)),
    "a list": lambda path: write(path, pa.table({"ra": [[1.0], [2.0]]})),
    "a struct": lambda path: write(path, pa.table({"ra": [{"x": 1.0}]})),
    "dates": lambda path: write(path, pa.table({"ra": pa.array([0], pa.timestamp("ns"))})),
    "bytes": lambda path: write(path, pa.table({"ra": [b"x"]})),
    "twice the column": lambda path: write(path, pa.table([GOOD["ra"], GOOD["ra"]], names=["ra", "ra"])),
    "another column": lambda path: write(path, GOOD.rename_columns(["RA", "name", "flag"])),
    "a path as a name": lambda path: write(path, pa.table({"a": [{"ra": 1.0}]})),
    "long texts": long_texts,
    "many texts": many_texts,
    "40 million zeros": zeros,
    "a folder": lambda path: path.mkdir(),
    "nothing": lambda path: None,
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_in_one_line(name, tmp_path):
    path = tmp_path / "theirs.parquet"
    BAD[name](path)
    with pytest.raises(BadInput, match="theirs") as caught:
        read(path)
    assert len(str(caught.value).splitlines()) == 1
    assert len(str(caught.value)) < 600


def test_a_good_file_is_read_as_it_is(tmp_path):
    path = tmp_path / "x.parquet"
    write(path, GOOD, row_group_size=300)
    found = read(path, ("name", "ra", "flag"))
    assert found["ra"].equals(GOOD["ra"])
    assert found["name"].cast(pa.string()).equals(GOOD["name"])
    assert found["flag"].equals(GOOD["flag"])


class Trap:
    """Object that reports when it is unpickled."""

    def __reduce__(self):
        return (pytest.fail, ("a pickle was read",))


def test_pickles_are_never_read(tmp_path):
    """pandas and pyarrow once stored pickles in a schema's metadata; they must stay bytes."""
    bait = pickle.dumps(Trap())
    extension = {"ARROW:extension:name": "arrow.py_extension_type", "ARROW:extension:metadata": bait}
    field = pa.field("ra", pa.float64(), metadata=extension)
    schema = pa.schema([field], metadata={"pandas": base64.b64encode(bait), "pickle": bait})
    path = tmp_path / "x.parquet"
    write(path, pa.Table.from_arrays([GOOD["ra"]], schema=schema))
    assert read(path)["ra"].equals(GOOD["ra"])


def test_statistics_are_not_believed(tmp_path):
    """Every row is returned, even if the statistics of a column in the footer are wrong."""
    path = tmp_path / "x.parquet"
    write(path, pa.table({"ra": np.arange(1.0, 101.0)}), use_dictionary=False, compression="none")
    data, last, start = (
        path.read_bytes(),
        np.float64(100.0).tobytes(),
        blocks.decode_blocks(parquet.file_checksums(path))[-2][0],
    )
    pages, tail = data[:start], data[start:]
    assert last in tail
    path.write_bytes(pages + tail.replace(last, np.float64(2.0).tobytes()))
    assert read(path)["ra"].to_pylist() == list(np.arange(1.0, 101.0))


@pytest.mark.parametrize("trials", [8, pytest.param(600, marks=pytest.mark.nightly)])
def test_changed_bytes_end_in_rows_or_in_one_line(trials, tmp_path):
    path = tmp_path / "theirs.parquet"
    write(path, GOOD)
    whole = np.frombuffer(path.read_bytes(), np.uint8)
    rng = np.random.default_rng(5)
    refused = []
    for _ in range(trials):
        data = whole.copy()
        places = rng.integers(0, data.size, rng.integers(1, 6))
        data[places] = rng.integers(0, 256, places.size)
        path.write_bytes(data.tobytes())
        try:
            read(path, ("ra", "name"))
        except BadInput as error:
            refused.append(str(error))
    assert len(refused) > trials / 20
    assert [text for text in refused if len(text.splitlines()) != 1] == []
