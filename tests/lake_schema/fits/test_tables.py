"""A binary table that is written in batches equals one that is written from memory."""

import io

import numpy as np
import pyarrow as pa
import pytest
from astropy.io import fits

from lake_schema.columns import Column, Table
from lake_schema.errors import BadInput
from lake_schema.fits.tables import stream_to_fits, table_to_fits

DECLARED = Table(
    "made",
    3,
    (
        Column("i", "int64", "", "meta.id", "identifier", nullable=True),
        Column("j", "int16", "pix", "", "pixel", nullable=True),
        Column("t", "int8", nullable=True),
        Column("s", "string", nullable=True),
        Column("b", "bool", nullable=True),
        Column("x", "float64", "deg", "pos.eq.ra", nullable=True),
        Column("f", "float32", "erg s-1 cm-2", nullable=True),
        Column("l", "list<float64>", nullable=True),
        Column("n", "list<int64>", nullable=True),
    ),
    "Made.",
    key=(),
)


def rows(number):
    rng = np.random.default_rng(number)
    values = {
        "i": rng.integers(-(2**63), 2**63 - 1, number), "j": rng.integers(-(2**15), 2**15, number).astype(np.int16),
        "t": rng.integers(-128, 128, number).astype(np.int8), "s": ["abc" * k for k in rng.integers(0, 9, number)],
        "b": rng.random(number) < 0.5, "x": rng.normal(size=number), "f": rng.normal(size=number).astype(np.float32),
        "l": [rng.normal(size=k).tolist() for k in rng.integers(0, 5, number)],
        "n": [rng.integers(9, size=k).tolist() for k in rng.integers(0, 5, number)],
    }  # fmt: skip
    values["i"][:2] = -(2**63), -(2**63) + 1
    missing = {name: rng.random(number) < 0.2 for name in values}
    missing["i"][:3] = False, False, True
    return pa.table({name: pa.array(own, mask=missing[name]) for name, own in values.items()}).cast(
        DECLARED.arrow_schema()
    )


def streamed(table, declared, size=7, most=None):
    file = io.BytesIO()
    stream_to_fits(file, lambda: table.to_batches(max_chunksize=size), declared, most)
    return file.getvalue()


@pytest.mark.parametrize("number", [3, 500])
def test_the_same_as_in_memory(tmp_path, number):
    table = rows(number)
    table_to_fits(tmp_path / "a.fits", table, DECLARED)
    data = streamed(table, DECLARED)
    assert len(data) % 2880 == 0
    assert data == streamed(table, DECLARED, 10**6)
    with (
        fits.open(tmp_path / "a.fits", logical_as_bytes=True) as one,
        fits.open(io.BytesIO(data), logical_as_bytes=True) as other,
    ):
        other.verify("exception")
        for name in DECLARED.names:
            for ours, theirs in zip(other[1].data[name], one[1].data[name], strict=True):
                np.testing.assert_array_equal(ours, theirs)
        for key, value in one[1].header.items():
            if not key.startswith(("TFORM", "CHECKSUM", "DATASUM", "PCOUNT", "NAXIS1", "THEAP")):
                assert other[1].header[key] == value
        assert other[1].header["TNULL1"] == -(2**63) + 2


def test_no_rows():
    with fits.open(io.BytesIO(streamed(rows(3).slice(0, 0), DECLARED))) as found:
        found.verify("exception")
        assert len(found[1].data) == 0


@pytest.mark.parametrize(
    ("column", "values", "words"),
    [
        (Column("s", "string"), ["\u00e9"], "cannot hold the character"),
        (Column("s\u00e9", "int64"), [1], "cannot hold"),
        (Column("l", "list<int64>"), [[1, None]], "missing value in a list"),
        (Column("j", "int8", nullable=True), [*range(-128, 128), None], ""),
        (Column("j", "int16", nullable=True), [*range(-(2**15), 2**15), None], "no integer is left"),
    ],
)
def test_values_that_fits_cannot_store_are_refused(column, values, words):
    declared = Table("made", 1, (column,), "Made.", key=())
    table = pa.table({column.name: values}).cast(declared.arrow_schema())
    if not words:
        assert len(streamed(table, declared)) % 2880 == 0
        return
    with pytest.raises(BadInput, match=words):
        streamed(table, declared)


def test_a_bound_of_bytes():
    declared = Table("made", 1, (Column("s", "string"),), "Made.", key=())
    table = pa.table({"s": ["x" * 1000, *["y"] * 999]})
    with pytest.raises(BadInput, match="more than"):
        streamed(table, declared, most=999_999)
    assert len(streamed(table, declared, most=1_000_000)) > 1_000_000
