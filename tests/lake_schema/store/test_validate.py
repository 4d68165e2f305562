"""Validation of all declared tables: every column, every kind of violation."""

import functools

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema.errors import BadInput
from lake_schema.store import manifest, parquet, validate
from lake_schema.tables import all_tables
from tests.universe import TOY, rows_of, toy_rows

TABLES = all_tables(["euclid_vis", "lsst_r"], variables=True)
each_table = pytest.mark.parametrize("table", TABLES, ids=lambda table: table.name)
# Tables for tests that change every column. Together they have every type of column; the others are checked at night.
VARIED = ("stars", "exposures", "tasks", "rendered_spectra", "galaxy_fluxes", "templates")
varied_tables = pytest.mark.parametrize(
    "table",
    [pytest.param(table, marks=() if table.name in VARIED else pytest.mark.nightly, id=table.name) for table in TABLES],
)


@functools.cache
def three_rows(table):
    return rows_of(table, 3)


def bounded(table):
    return [c for c in table.columns if c.lo is not None or c.hi is not None]


def refused(rows, table, *words):
    with pytest.raises(BadInput) as found:
        validate.check_rows(rows, table)
    assert all(word in str(found.value) for word in (table.name, *words)), str(found.value)


def test_varied_tables_have_every_type_of_column():
    types = {column.type for table in TABLES if table.name in VARIED for column in table.columns}
    assert types == {column.type for table in TABLES for column in table.columns}


@each_table
def test_good_rows_pass(table):
    assert validate.find_violations(rows_of(table, 50), table) == []
    assert validate.find_violations(table.empty(), table) == []


@each_table
def test_a_missing_renamed_or_extra_column(table):
    rows = three_rows(table)
    for column in table.columns:
        refused(rows.drop_columns([column.name]), table, column.name, "missing")
        names = [f"{n}_" if n == column.name else n for n in rows.column_names]
        refused(rows.rename_columns(names), table, column.name, "missing")
    refused(rows.append_column("extra", pa.array([1, 2, 3])), table, "extra")


@each_table
def test_a_wrong_type_unit_or_nullability(table):
    rows = three_rows(table)
    for place, column in enumerate(table.columns):
        field = rows.schema.field(place)
        assert field.name == column.name
        other = pa.float64() if field.type != pa.float64() else pa.float32()
        zeros = pa.array([0, 0, 0], other)
        refused(rows.set_column(place, field.with_type(other), zeros), table, column.name, "but must be")
        metadata = {**field.metadata, b"unit": b"furlong"}
        refused(
            rows.set_column(place, field.with_metadata(metadata), rows.column(place)), table, column.name, "furlong"
        )
        flipped = field.with_nullable(not field.nullable)
        refused(rows.set_column(place, flipped, rows.column(place)), table, column.name, "nullable")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@varied_tables
def test_nan_and_infinity_are_refused(table, bad):
    for column in table.columns:
        if column.is_float or column.type.startswith("list<float"):
            refused(changed(three_rows(table), column, bad), table, column.name, "row 1")


@varied_tables
def test_a_value_out_of_bounds(table):
    for column in bounded(table):
        kind = np.dtype(column.type.removeprefix("list<").removesuffix(">"))
        limits = np.finfo(kind) if kind.kind == "f" else np.iinfo(kind)
        for bound, beyond in ((column.lo, limits.min), (column.hi, limits.max)):
            if bound is not None and beyond != bound:
                refused(changed(three_rows(table), column, beyond), table, column.name, "row 1")


@varied_tables
def test_the_bounds_themselves_are_legal(table):
    for column in bounded(table):
        for bound in (column.lo, column.hi):
            if bound is not None and column.name not in table.key and not column.codes:
                value = bound if column.is_float else int(bound)
                assert validate.find_violations(changed(three_rows(table), column, value), table) == [], column.name


@varied_tables
def test_a_missing_value_only_where_declared(table):
    for place, column in enumerate(table.columns):
        rows = three_rows(table)
        values = rows.column(place).to_pylist()
        values[1] = None
        holed = rows.set_column(place, rows.schema.field(place), pa.array(values, rows.schema.field(place).type))
        if column.nullable:
            assert validate.find_violations(holed, table) == [], column.name
        else:
            refused(holed, table, column.name, "row 1")


def changed(rows, column, value, row=1):
    place = rows.column_names.index(column.name)
    field = rows.schema.field(place)
    values = rows.column(place).to_pylist()
    values[row] = [value] if column.type.startswith("list") and value is not None else value
    return rows.set_column(place, field, pa.array(values, field.type))


def test_a_duplicate_id_names_both_rows():
    rows = toy_rows(1607, 10)
    ids = rows["id"].to_pylist()
    ids[7] = ids[2]
    refused(rows.set_column(0, rows.schema.field(0), pa.array(ids)), TOY, "rows 2 and 7")


def test_an_unknown_code():
    exposures = next(t for t in TABLES if t.name == "exposures")
    refused(changed(rows_of(exposures, 3), exposures.column("channel"), "RADIO"), exposures, "channel", "RADIO")


def test_a_compound_key():
    tasks = next(t for t in TABLES if t.name == "tasks")
    rows = rows_of(tasks, 3)
    refused(pa.concat_tables([rows, rows]), tasks, "rows 0 and 3")


# Unusual but valid numbers: kept bit by bit if the bounds allow them, else refused.
ODD = {
    "minus zero": -0.0,
    "denormal": 5e-324,
    "small denormal32": 1e-45,
    "1e308": 1e308,
    "-1e308": -1e308,
    "minus one": -1.0,
}


@pytest.mark.parametrize("number", ODD.values(), ids=ODD)
@varied_tables
def test_an_odd_number_is_kept_or_refused_but_never_changed(table, number, tmp_path):
    """Each column is checked alone; the allowed numbers of all columns are then written to one file."""
    rows, kept = three_rows(table), {}
    for column in table.columns:
        # 1e308 exceeds the range of float32.
        if not column.is_float or (abs(number) > 1e300 and column.type != "float64"):
            continue
        value = np.dtype(column.type).type(number)
        own = changed(three_rows(table), column, float(value))
        lo = -np.inf if column.lo is None else column.lo
        hi = np.inf if column.hi is None else column.hi
        if not lo <= value <= hi:
            refused(own, table, column.name, "row 1")
            continue
        assert validate.find_violations(own, table) == [], column.name
        rows, kept[column.name] = changed(rows, column, float(value)), value
    parquet.write(tmp_path / "x.parquet", rows, table)
    entry = manifest.file_entry(tmp_path / "x.parquet", "x.parquet")
    back = parquet.open_dataset(tmp_path, [entry], table.arrow_schema()).to_table()
    for name, value in kept.items():
        assert back[name].to_numpy()[1].tobytes() == value.tobytes(), name


@st.composite
def tables_and_rows(draw):
    """Draw a declared table and rows within the bounds of its columns, including the bounds themselves."""
    table = draw(st.sampled_from([t for t in TABLES if not t.is_catalogue] + [TOY, TABLES[0], TABLES[1]]))
    rows = rows_of(table, draw(st.integers(1, 20)), draw(st.integers(0, 2**32 - 1)))
    for column in table.columns:
        if column.is_float and column.name not in (*table.key, "ra", "dec") and draw(st.booleans()):
            width = int(column.type.removeprefix("float"))
            lo, hi = (b if b is None else float(np.dtype(column.type).type(b)) for b in (column.lo, column.hi))
            number = draw(st.floats(lo, hi, width=width, allow_nan=False, allow_infinity=False))
            rows = changed(rows, column, number, draw(st.integers(0, rows.num_rows - 1)))
    return table, rows


def mutations(table, rows, column):
    """Return every single way to violate the declaration of a column."""
    yield rows.drop_columns([column.name])
    yield rows.rename_columns([f"{n}_" if n == column.name else n for n in rows.column_names])
    place = rows.column_names.index(column.name)
    yield rows.set_column(place, rows.schema.field(place).with_nullable(not column.nullable), rows.column(place))
    if column.is_float:
        yield from (changed(rows, column, bad, 0) for bad in (float("nan"), float("inf"), float("-inf")))
    if not column.nullable:
        yield changed(rows, column, None, rows.num_rows - 1)


@given(tables_and_rows(), st.data())
def test_declared_rows_pass_and_every_mutation_is_refused(example, data):
    table, rows = example
    assert validate.find_violations(rows, table) == []
    column = data.draw(st.sampled_from(table.columns))
    for spoiled in mutations(table, rows, column):
        refused(spoiled, table, column.name)
