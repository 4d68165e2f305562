"""Declarations: schemas, metadata and values of columns."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from astropy import units
from astropy.io.votable.ucd import check_ucd
from hypothesis import given
from hypothesis import strategies as st

from lake_schema.columns import Column, Table, round_mantissa
from lake_schema.errors import BadInput
from lake_schema.fits.tables import fits_unit
from lake_schema.store import manifest, parquet
from lake_schema.tables import all_tables
from tests.universe import TOY, rows_of

TABLES = all_tables(["euclid_vis", "lsst_r"], variables=True)


@pytest.mark.parametrize("table", TABLES, ids=lambda t: t.name)
def test_units_and_ucds_are_standard(table):
    for column in table.columns:
        unit = units.Unit(column.unit, parse_strict="raise")
        if units.electron not in unit.bases:  # FITS has no name for it.
            assert units.Unit(fits_unit(column.unit), format="fits") == unit, column.name
        assert column.doc, column.name
        assert not column.ucd or check_ucd(column.ucd, check_controlled_vocabulary=True), column.name


@pytest.mark.parametrize("table", TABLES, ids=lambda t: t.name)
def test_metadata_survives_into_the_file(table, tmp_path):
    parquet.write(tmp_path / "x.parquet", rows_of(table, 5), table)
    assert pq.read_schema(tmp_path / "x.parquet").equals(table.arrow_schema(), check_metadata=True)


@pytest.mark.parametrize("table", TABLES, ids=lambda t: t.name)
def test_values_survive_the_encodings(table, tmp_path):
    rows = rows_of(table, 1000)
    parquet.write(tmp_path / "x.parquet", rows, table)
    entry = manifest.file_entry(tmp_path / "x.parquet", "x.parquet")
    assert parquet.open_dataset(tmp_path, [entry], table.arrow_schema()).to_table().equals(rows)


@pytest.mark.parametrize("table", TABLES, ids=lambda t: t.name)
def test_markdown_names_every_column(table):
    page = table.to_markdown()
    assert all(f"| `{name}` |" in page for name in table.names)


def build(**changes):
    good = {"id": [1, 2], "ra": [0.0, 1.0], "dec": [0.0, 1.0], "_healpix_29": [0, 1], "flux": np.zeros(2)}
    return TOY.build({**good, **changes})


def test_build_refuses_by_name():
    for changes, words in (
        ({"speed": [1, 2]}, "no column speed"),
        ({"id": np.array([1.5, 2.5])}, "column id must be int64"),
        ({"ra": ["a", "b"]}, "column ra must be float64"),
        ({"flux": [None, 1.0]}, "column flux has 1 missing"),
    ):
        with pytest.raises(BadInput, match=words):
            build(**changes)
    with pytest.raises(BadInput, match="flux is missing"):
        TOY.build({"id": [1], "ra": [0.0], "dec": [0.0], "_healpix_29": [0]})


def test_masked_values_become_null_only_where_declared():
    table = Table("t", 1, (Column("id", "int64"), Column("x", "float32", nullable=True)), "t")
    rows = table.build({"id": [1, 2], "x": np.ma.masked_array([1.0, np.nan], [False, True])})
    assert rows["x"].to_pylist() == [1.0, None]
    assert table.build({"id": [1]})["x"].null_count == 1


def test_small_integers_do_not_wrap():
    table = Table("t", 1, (Column("k", "int8"),), "t", key=("k",))
    with pytest.raises(BadInput, match="outside the range of int8"):
        table.build({"k": np.array([300])})


def test_a_column_declared_twice_is_refused():
    with pytest.raises(BadInput, match="twice"):
        Table("t", 1, (Column("id", "int64"), Column("id", "int64")), "t")


@given(st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), min_size=1), st.integers(1, 22))
def test_rounding_keeps_its_relative_error(values, bits):
    given_values = np.array(values, np.float32)
    # The largest numbers round up to infinity, and subnormal numbers have fewer bits.
    normal = (np.abs(given_values) < 1e38) & (np.abs(given_values) > 1e-37)
    rounded = round_mantissa(given_values, bits)
    error = np.abs(rounded.astype(float) - given_values.astype(float))[normal]
    assert (error <= 2.0 ** -(bits + 1) * np.abs(given_values[normal].astype(float))).all()
    assert np.array_equal(round_mantissa(rounded, bits)[normal], rounded[normal])


@pytest.mark.parametrize(
    ("kind", "bits"), [("float64", 12), ("int64", 12), ("float32", 0), ("float32", 24), ("float16", None)]
)
def test_only_float32_may_be_rounded(kind, bits):
    with pytest.raises(BadInput, match="column x"):
        Column("x", kind, mantissa_bits=bits)


@pytest.mark.parametrize("bits", [1, 23])
def test_the_fewest_and_the_most_bits_are_legal(bits):
    assert Column("x", "float32", mantissa_bits=bits).metadata()["mantissa_bits"] == str(bits)
    assert "mantissa_bits" not in Column("x", "float32").metadata()


def test_columns_are_encoded_by_their_kind(tmp_path):
    """Floats use byte stream split, integers delta encoding, and columns with few values dictionaries."""
    columns = Column("id", "int64"), Column("x", "float32"), Column("kind", "int8", codes=((0, "a"), (1, "b")))
    table = Table("t", 1, (*columns, Column("name", "string"), Column("good", "bool")), "t")
    rows = {"id": np.arange(9), "x": np.ones(9), "kind": np.arange(9) % 2, "name": ["n"] * 9, "good": [True] * 9}
    parquet.write(tmp_path / "x.parquet", table.build(rows), table)
    group = pq.ParquetFile(tmp_path / "x.parquet").metadata.row_group(0)
    found = {group.column(k).path_in_schema: set(group.column(k).encodings) for k in range(group.num_columns)}
    assert "DELTA_BINARY_PACKED" in found["id"]
    assert "BYTE_STREAM_SPLIT" in found["x"]
    for name in ("kind", "name"):
        assert "RLE_DICTIONARY" in found[name]
    assert not {"RLE_DICTIONARY", "DELTA_BINARY_PACKED", "BYTE_STREAM_SPLIT"} & found["good"]


def test_a_rounded_column_is_rounded_when_it_is_built_and_says_so():
    table = Table("t", 1, (Column("id", "int64"), Column("x", "float32", mantissa_bits=8)), "t")
    rows = table.build({"id": [1], "x": np.array([np.pi])})
    assert rows["x"][0].as_py() == round_mantissa(np.array([np.pi], np.float32), 8)[0] != np.float32(np.pi)
    assert rows.schema.field("x").metadata[b"mantissa_bits"] == b"8"


def test_rounding_leaves_infinities():
    values = np.array([np.inf, -np.inf, np.nan], np.float32)
    assert np.array_equal(round_mantissa(values, 5), values, equal_nan=True)


def test_list_columns_are_lists_of_numbers():
    table = Table("t", 1, (Column("id", "int64"), Column("cells", "list<int64>")), "t")
    assert pa.types.is_list(table.build({"id": [1], "cells": [[1, 2]]}).schema.field("cells").type)
