"""A lake that was written by an earlier truesky: read where that is safe, refused by name where it is not."""

from dataclasses import replace

import pytest

from lake_schema import listing
from lake_schema.columns import Column
from lake_schema.errors import VersionMismatch
from lake_schema.store import garbage, publish, read
from lake_schema.tables.galaxies import GALAXIES
from tests.make_old_lake import OLD_LAKE
from tests.universe import PLAIN, plain_plan, plain_work, rows_of

# What the old lake was written as, and what it is read with.
EARLIER = GALAXIES.earlier
FIRST = replace(EARLIER, version=1, columns=tuple(column for column in EARLIER.columns if column.since == 1))
LATER = Column("colour", "float32", doc="colour", nullable=True, since=2)


@pytest.fixture
def old():
    return read.version(OLD_LAKE, "plain")


def later(*columns, version=2):
    return replace(PLAIN, version=version, columns=columns)


def test_the_old_lake_is_whole():
    assert sorted(read.tables(OLD_LAKE)) == ["galaxies", "plain"]
    for name in read.tables(OLD_LAKE):
        assert read.verify(read.version(OLD_LAKE, name), deep=True) == []


def test_an_old_lake_belongs_to_nobody_and_serves_everybody():
    version = read.version(OLD_LAKE, "plain")
    assert read.for_request(OLD_LAKE, "plain", "anybody").key == version.key
    assert garbage.collect(OLD_LAKE) == []
    (row,) = (row for row in listing.rows(OLD_LAKE) if row["table"] == "plain")
    assert (row["version"], row["names"], row["current"], row["rows"]) == (version.key, [], True, 60)


def test_galaxies_of_an_old_lake():
    """Fails where GALAXIES changed so that written lakes cannot be read: give it a version, and the column `since`."""
    rows = read.version(OLD_LAKE, "galaxies").rows()
    assert rows.schema.equals(EARLIER.arrow())
    written = rows_of(FIRST, 12)
    for name in ("id", "ra", "z_true", "sed_1"):
        assert rows[name].equals(written[name])


def test_a_later_nullable_column_is_null(old):
    table = later(*PLAIN.columns, LATER)
    version = read.as_declared(old, table)
    assert version.schema.equals(table.arrow(), check_metadata=True)
    assert version.rows()["colour"].null_count == version.num_rows == 60
    assert version.rows(["id", "colour"]).drop_columns("colour").equals(old.rows(["id"]))
    assert version.rows(where=read.pc.field("colour") > 0).num_rows == 0


BAD = {
    "a later column that must be there": (
        later(*PLAIN.columns, replace(LATER, nullable=False)),
        "column colour is missing",
    ),
    "a nullable column that was always there": (
        later(*PLAIN.columns, replace(LATER, since=1)),
        "column colour is missing",
    ),
    "another type": (later(PLAIN.columns[0], replace(PLAIN.columns[1], type="float32")), "column value is"),
    "another unit": (later(PLAIN.columns[0], replace(PLAIN.columns[1], unit="deg")), "has unit '', wanted 'deg'"),
    "a column that went": (later(PLAIN.columns[0]), "column value is not declared"),
}


@pytest.mark.parametrize("name", BAD)
def test_any_other_difference_is_refused_naming_both_versions(old, name):
    table, words = BAD[name]
    with pytest.raises(VersionMismatch, match=r"table plain: version 1 .* version 2: ") as caught:
        read.as_declared(old, table)
    assert words in str(caught.value)


def test_a_column_that_went_is_passed_over_where_it_is_said(old):
    """In lakes that have it; a lake of this version may not."""
    table = replace(later(PLAIN.columns[0]), former=("value",))
    assert read.as_declared(old, table).rows().column_names == ["id"]
    with pytest.raises(VersionMismatch, match="column value is not declared"):
        read.as_declared(old, replace(table, version=1))


def test_a_table_from_the_future_is_refused(lake):
    plan = plain_plan()
    publish.make(lake, replace(plan, table=replace(PLAIN, version=3)), plain_work)
    with pytest.raises(VersionMismatch, match=r"version 3 .* version 1: it was written by a later truesky"):
        read.as_declared(read.version(lake, "plain"), PLAIN)


def test_a_lake_is_read_as_declared_without_being_asked(lake, monkeypatch):
    """`read.version` itself looks the table up."""
    wider = replace(EARLIER, version=3, columns=(*EARLIER.columns, LATER))
    monkeypatch.setattr("lake_schema.tables.galaxies.GALAXIES", wider)
    rows = read.version(OLD_LAKE, "galaxies").rows(["id", "colour"])
    assert rows["colour"].null_count == 12
    narrower = replace(EARLIER, version=3, columns=FIRST.columns[:-1])
    monkeypatch.setattr("lake_schema.tables.galaxies.GALAXIES", narrower)
    with pytest.raises(VersionMismatch, match="table galaxies: version 1"):
        read.version(OLD_LAKE, "galaxies")


def test_a_unit_is_refused_after_the_right_one_was_read(lake):
    """Of the same columns and types: what a process has read before does not stand in for it."""
    publish.make(lake, plain_plan(), plain_work)
    version = read.version(lake, "plain")
    assert read.as_declared(version, PLAIN).schema.names == version.schema.names
    own = version.schema.field(0)
    other = version.schema.set(0, own.with_metadata({**(own.metadata or {}), b"unit": b"furlong"}))
    assert other == version.schema
    with pytest.raises(VersionMismatch, match="unit 'furlong'"):
        read.as_declared(replace(version, schema=other), PLAIN)
