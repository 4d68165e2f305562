"""Validation: every declared table, every column, every kind of wrong."""

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema.errors import BadInput
from lake_schema.store import manifest, parquet, validate
from lake_schema.tables import declared
from tests.universe import TOY, rows_of, toy_rows

TABLES = declared(["euclid_vis", "lsst_r"])
COLUMNS = [pytest.param(t, c, id=f"{t.name}.{c.name}") for t in TABLES for c in t.columns]
LISTS = [p for p in COLUMNS if p.values[1].type.startswith("list<float")]
FLOATS = [pytest.param(t, c, id=f"{t.name}.{c.name}") for t in TABLES for c in t.columns if c.is_float]
BOUNDED = [p for p in COLUMNS if p.values[1].lo is not None or p.values[1].hi is not None]


def refused(rows, table, *words):
    found = validate.violations(rows, table)
    assert found, "nothing was found wrong"
    assert all(word in found[0] for word in (table.name, *words)), found[0]
    with pytest.raises(BadInput):
        validate.check(rows, table)


@pytest.mark.parametrize("table", TABLES, ids=lambda t: t.name)
def test_good_rows_pass(table):
    assert validate.violations(rows_of(table, 50), table) == []
    assert validate.violations(table.empty(), table) == []


@pytest.mark.parametrize(("table", "column"), COLUMNS)
def test_a_missing_renamed_or_extra_column(table, column):
    rows = rows_of(table, 3)
    refused(rows.drop_columns([column.name]), table, column.name, "missing")
    names = [f"{n}_" if n == column.name else n for n in rows.column_names]
    refused(rows.rename_columns(names), table, column.name, "missing")
    refused(rows.append_column("extra", pa.array([1, 2, 3])), table, "extra")


@pytest.mark.parametrize(("table", "column"), COLUMNS)
def test_a_wrong_type_unit_or_nullability(table, column):
    rows = rows_of(table, 3)
    place = rows.column_names.index(column.name)
    field = rows.schema.field(place)
    other = pa.float64() if field.type != pa.float64() else pa.float32()
    refused(rows.set_column(place, field.with_type(other), pa.array([0, 0, 0], other)), table, column.name, "wanted")
    metadata = {**field.metadata, b"unit": b"furlong"}
    refused(rows.set_column(place, field.with_metadata(metadata), rows.column(place)), table, column.name, "furlong")
    flipped = field.with_nullable(not field.nullable)
    refused(rows.set_column(place, flipped, rows.column(place)), table, column.name, "nullable")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(("table", "column"), FLOATS + LISTS)
def test_a_number_that_is_none(table, column, bad):
    refused(changed(rows_of(table, 3), column, bad), table, column.name, "row 1")


@pytest.mark.parametrize(("table", "column"), BOUNDED)
def test_a_value_out_of_bounds(table, column):
    kind = np.dtype(column.type.removeprefix("list<").removesuffix(">"))
    limits = np.finfo(kind) if kind.kind == "f" else np.iinfo(kind)
    for bound, beyond in ((column.lo, limits.min), (column.hi, limits.max)):
        if bound is not None and beyond != bound:
            refused(changed(rows_of(table, 3), column, beyond), table, column.name, "row 1")


@pytest.mark.parametrize(("table", "column"), BOUNDED)
def test_the_bounds_themselves_are_legal(table, column):
    for bound in (column.lo, column.hi):
        if bound is not None and column.name not in table.key and not column.codes:
            value = bound if column.is_float else int(bound)
            assert validate.violations(changed(rows_of(table, 3), column, value), table) == []


@pytest.mark.parametrize(("table", "column"), COLUMNS)
def test_a_missing_value_only_where_declared(table, column):
    rows = rows_of(table, 3)
    place = rows.column_names.index(column.name)
    values = rows.column(place).to_pylist()
    values[1] = None
    holed = rows.set_column(place, rows.schema.field(place), pa.array(values, rows.schema.field(place).type))
    if column.nullable:
        assert validate.violations(holed, table) == []
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


# Numbers that are strange and legal: kept to the bit where the bounds admit them, refused where they do not.
ODD = {
    "minus zero": -0.0,
    "denormal": 5e-324,
    "small denormal32": 1e-45,
    "1e308": 1e308,
    "-1e308": -1e308,
    "minus one": -1.0,
}


ODD_COLUMNS = [
    pytest.param(*p.values, number, id=f"{p.id}-{name}")
    for p in FLOATS
    for name, number in ODD.items()
    if abs(number) < 1e300 or p.values[1].type == "float64"  # 1e308 is no float32
]


@pytest.mark.parametrize(("table", "column", "number"), ODD_COLUMNS)
def test_an_odd_number_is_kept_or_refused_but_never_changed(table, column, number, tmp_path):
    value = np.dtype(column.type).type(number)
    rows = changed(rows_of(table, 3), column, float(value))
    lo = -np.inf if column.lo is None else column.lo
    hi = np.inf if column.hi is None else column.hi
    if not lo <= value <= hi:
        refused(rows, table, column.name, "row 1")
        return
    assert validate.violations(rows, table) == []
    parquet.write(tmp_path / "x.parquet", rows, table)
    entry = manifest.file_facts(tmp_path / "x.parquet", "x.parquet")
    back = parquet.dataset(tmp_path, [entry], table.arrow()).to_table()[column.name].to_numpy()
    assert back[1].tobytes() == value.tobytes()


@st.composite
def tables_and_rows(draw):
    """Any declared table with rows drawn from the bounds of its columns, the bounds themselves among them."""
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
    """Every single way to spoil a column."""
    yield rows.drop_columns([column.name])
    yield rows.rename_columns([f"{n}_" if n == column.name else n for n in rows.column_names])
    place = rows.column_names.index(column.name)
    yield rows.set_column(place, rows.schema.field(place).with_nullable(not column.nullable), rows.column(place))
    if column.is_float:
        yield from (changed(rows, column, bad, 0) for bad in (float("nan"), float("inf"), float("-inf")))
    if not column.nullable:
        yield changed(rows, column, None, rows.num_rows - 1)


@given(tables_and_rows(), st.data())
def test_what_is_declared_passes_and_any_one_mutation_is_refused(example, data):
    table, rows = example
    assert validate.violations(rows, table) == []
    column = data.draw(st.sampled_from(table.columns))
    for spoiled in mutations(table, rows, column):
        refused(spoiled, table, column.name)
