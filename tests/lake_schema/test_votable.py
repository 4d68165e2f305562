"""The VOTable header of Parquet files, as other readers use it."""

import io
import warnings

import pyarrow.parquet as pq
import pytest
from astropy import units
from astropy.io import votable as astropy_votable
from astropy.table import Table

from lake_schema import tables, votable
from lake_schema.store import parquet
from tests.universe import PLAIN, rows_of

DECLARED = tables.all_tables(["euclid_vis", "lsst_r"], variables=True)


def opened(path):
    """Open a file as a user does; astropy warns about some units and guesses lengths of texts."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Table.read(path, format="parquet.votable")


@pytest.mark.parametrize("table", DECLARED, ids=lambda table: table.name)
def test_astropy_sees_units_and_ucds_and_the_same_rows(tmp_path, table):
    rows = rows_of(table, 7)
    parquet.write(tmp_path / "x.parquet", rows, table)
    found = opened(tmp_path / "x.parquet")
    assert found.colnames == table.names
    for column in table.columns:
        shown = found[column.name]
        # VOUnit defines a different unit of the name electron.
        assert units.Unit(str(shown.unit or "")) == units.Unit(column.unit)
        assert shown.meta.get("ucd", "") == column.ucd
        assert shown.description == column.doc
        assert [list(v) if column.type.startswith("list") else v for v in shown] == rows[column.name].to_pylist()


@pytest.mark.parametrize("table", DECLARED, ids=lambda table: table.name)
def test_the_header_is_a_votable(table):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", units.UnitsWarning)
        (field, *_) = (
            astropy_votable.parse(io.BytesIO(votable.table_header(table).encode()), verify="exception")
            .get_first_table()
            .fields
        )
    assert field.name == table.names[0]


def test_missing_texts_and_no_rows(tmp_path):
    table = next(table for table in DECLARED if table.name == "exposures")
    rows = rows_of(table, 3)
    gaps = rows.set_column(rows.column_names.index("target"), rows.schema.field("target"), [[None, "abc", None]])
    for n in (0, 3):
        parquet.write(tmp_path / "x.parquet", gaps.slice(0, n), table)
        text = pq.read_metadata(tmp_path / "x.parquet").metadata[votable.CONTENT.encode()].decode()
        assert f'name="target" datatype="char" arraysize="{3 if n else 1}*"' in text


def test_our_own_schema_is_as_declared(tmp_path):
    """The header is only in the footer and does not change the Arrow schema of a file."""
    parquet.write(tmp_path / "x.parquet", rows_of(PLAIN, 3), PLAIN)
    assert pq.read_schema(tmp_path / "x.parquet").equals(PLAIN.arrow_schema(), check_metadata=True)
