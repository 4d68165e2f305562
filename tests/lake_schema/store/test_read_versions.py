"""Tables with another declaration are refused by name, with the difference."""

from dataclasses import replace

import pytest

from lake_schema.columns import Column
from lake_schema.errors import VersionMismatch
from lake_schema.store import layout, publish, read
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.galaxies import GALAXIES
from tests.universe import PLAIN, plain_plan, plain_work, rows_of

COLOUR = Column("colour", "float32", doc="colour", nullable=True)


@pytest.fixture
def plain(lake):
    publish.make_version(lake, plain_plan(), plain_work)
    return read.version(lake, "plain")


def with_columns(*columns):
    return replace(PLAIN, columns=columns)


BAD = {
    "a column more": (with_columns(*PLAIN.columns, COLOUR), "column colour is missing"),
    "another type": (with_columns(PLAIN.columns[0], replace(PLAIN.columns[1], type="float32")), "column value is"),
    "another unit": (
        with_columns(PLAIN.columns[0], replace(PLAIN.columns[1], unit="deg")),
        "column value has unit '', but must have 'deg'",
    ),
    "a column less": (with_columns(PLAIN.columns[0]), "column value is not declared"),
}


@pytest.mark.parametrize("name", BAD)
def test_other_columns_are_refused_by_name(plain, name):
    table, words = BAD[name]
    with pytest.raises(VersionMismatch, match=f"^table plain: {words}.*: written by another version of truesky$"):
        read.with_declared_schema(plain, table)


@pytest.mark.parametrize(("was", "now"), [(3, 1), (1, 2)])
def test_another_version_is_refused_naming_both(lake, was, now):
    publish.make_version(lake, replace(plain_plan(), table=replace(PLAIN, version=was)), plain_work)
    who = "written by another version of truesky"
    line = f"table plain: {who}: it has version {was} of the declaration, but this truesky reads version {now}"
    with pytest.raises(VersionMismatch, match=f"^{line}$"):
        read.with_declared_schema(read.version(lake, "plain"), replace(PLAIN, version=now))


def test_reading_compares_a_table_with_its_declaration(lake, monkeypatch):
    """`read.version` itself looks up the declaration."""
    plan = Plan(GALAXIES, {}, (Task(layout.cell_file(5, 1607), {}),))
    publish.make_version(lake, plan, lambda root, facts: Output(rows_of(GALAXIES, 12)))
    monkeypatch.setattr("lake_schema.tables.galaxies.GALAXIES", replace(GALAXIES, columns=GALAXIES.columns[:-1]))
    with pytest.raises(VersionMismatch, match=r"^table galaxies: column stamp is not declared"):
        read.version(lake, "galaxies")


def test_a_unit_is_refused_after_the_right_one_was_read(plain):
    """A cached schema with the same columns and types must not hide another unit."""
    assert read.with_declared_schema(plain, PLAIN).schema.names == plain.schema.names
    own = plain.schema.field(0)
    other = plain.schema.set(0, own.with_metadata({**(own.metadata or {}), b"unit": b"furlong"}))
    assert other == plain.schema
    with pytest.raises(VersionMismatch, match="unit 'furlong'"):
        read.with_declared_schema(replace(plain, schema=other), PLAIN)
