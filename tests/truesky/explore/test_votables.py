"""astropy reads VOTables of any rows without a change of values."""

import io

import numpy as np
import pyarrow as pa
import pytest
from astropy.io.votable import parse

from truesky.explore import votables

# astropy warns of non-ASCII characters, which current readers accept; pytest-xdist cannot pass these warnings on.
pytestmark = pytest.mark.filterwarnings("ignore:.*non-ASCII")

COLUMNS = {
    "long": pa.array([2**62 + 1, None, -5], pa.int64()),
    "short": pa.array([None, 7, -8], pa.int8()),
    "double": pa.array([0.1 + 0.2, None, np.inf], pa.float64()),
    "float": pa.array([np.float32(0.1), np.nan, None], pa.float32()),
    "flag": pa.array([True, None, False]),
    "text": pa.array(['a <&> "b" \' é', None, "x\x00y"]),
    "list": pa.array([[1.5, 2.25], [], None], pa.list_(pa.float32())),
}


def read(data):
    return parse(io.BytesIO(data), verify="exception")


def made(most=None):
    facts = {"unit": "deg", "ucd": "pos", "description": "a & b"}
    schema = pa.schema(
        [pa.field(k, column.type, metadata=facts if k == "double" else None) for k, column in COLUMNS.items()]
    )
    batch = pa.RecordBatch.from_arrays(list(COLUMNS.values()), schema=schema)
    cut = votables.RowLimit(most)
    return b"".join(votables.pieces([batch.slice(0, 0), batch.slice(0, 2), batch.slice(2)], cut)), cut


def test_values_come_back():
    found = read(made()[0]).get_first_table()
    table = found.to_table()
    assert table["long"].tolist() == [2**62 + 1, None, -5]
    assert table["short"].tolist() == [None, 7, -8]
    assert table["double"][0] == 0.1 + 0.2
    assert np.isposinf(table["double"][2])
    assert table["float"][0] == np.float32(0.1)
    assert table["flag"].tolist() == [True, None, False]
    assert [str(text) for text in table["text"]] == ['a <&> "b" \' é', "", "x\N{REPLACEMENT CHARACTER}y"]
    assert [list(values) for values in table["list"]][:2] == [[1.5, 2.25], []]
    assert (str(table["double"].unit), found.fields[2].ucd, table["double"].description) == ("deg", "pos", "a & b")


@pytest.mark.parametrize(("most", "overflowed"), [(0, True), (1, True), (2, True), (3, False), (None, False)])
def test_overflow_is_reported(most, overflowed):
    data, cut = made(most)
    assert cut.overflowed == overflowed == (b'value="OVERFLOW"' in data)
    assert len(read(data).get_first_table().array) == (3 if most is None else most)


def test_error_document():
    (info,) = read(votables.refusal("no <table> & \x01")).resources[0].infos
    assert (info.name, info.value) == ("QUERY_STATUS", "ERROR")
    assert info.content == "no <table> & \N{REPLACEMENT CHARACTER}"


def test_what_is_missing_in_a_list_of_whole_numbers():
    rows = pa.record_batch({"a": pa.array([[1, None, -3], []], pa.list_(pa.int64()))})
    data = b"".join(votables.pieces([rows]))
    assert b"NaN" not in data
    assert np.ma.asarray(read(data).get_first_table().array["a"][0]).tolist() == [1, None, -3]


@pytest.mark.parametrize("character", ["\ufffe", "\uffff", "\x0b"])
def test_characters_that_xml_lacks(character):
    (text,) = read(b"".join(votables.pieces([pa.record_batch({"a": [f"x{character}y"]})]))).get_first_table().array["a"]
    assert text == "x\N{REPLACEMENT CHARACTER}y"


@pytest.mark.parametrize("most", [None, 50_000, 0])
def test_pieces_of_many_rows_are_small(most):
    """Pieces are small for batches of any size, since values as text need much more memory."""
    batch = pa.RecordBatch.from_pydict({"a": np.arange(100_000), "b": np.arange(100_000) / 7})
    cut = votables.RowLimit(most)
    pieces = [*votables.pieces([batch], cut)]
    assert max(map(len, pieces)) < 1 << 20
    assert b"".join(pieces).count(b"<TR>") == (100_000 if most is None else most)
    assert cut.overflowed == (most is not None)
