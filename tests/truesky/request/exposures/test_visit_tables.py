"""Tables of visits of the Rubin Observatory's scheduler in three formats; each mistake is one line."""

import csv
import sqlite3
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lake_schema.errors import BadInput
from truesky.request.exposures import visit_tables

BANDS = ("lsst_u", "lsst_g", "lsst_r", "lsst_i", "lsst_z", "lsst_y")
# Twenty visits that OpSim simulated; the file of test_opsim.py.
FILE = Path(__file__).parents[2] / "render" / "sky" / "opsim_visits.csv"
NAMES = [
    "observationStartMJD", "fieldRA", "fieldDec", "filter", "rotSkyPos", "seeingFwhmEff", "airmass", "skyBrightness",
    "visitExposureTime", "numExposures",
]  # fmt: skip


@pytest.fixture(scope="module")
def table():
    """The visits as columns of numbers and of texts."""
    with FILE.open() as stream:
        rows = list(csv.DictReader(stream))
    return {name: [row[name] if name == "filter" else float(row[name]) for row in rows] for name in rows[0]}


def write_sqlite(path, table, name="observations"):
    with sqlite3.connect(path) as connection:
        kinds = ", ".join(f'"{column}" {"TEXT" if column == "filter" else "REAL"}' for column in table)
        connection.execute(f"CREATE TABLE {name} ({kinds})")
        marks = ", ".join("?" * len(table))
        connection.executemany(f"INSERT INTO {name} VALUES ({marks})", zip(*table.values(), strict=True))
    return path


def write_csv(path, table):
    lines = [",".join(table), *(",".join(map(str, row)) for row in zip(*table.values(), strict=True))]
    path.write_text("\n".join(lines) + "\n")
    return path


def read(path, bands=BANDS):
    assert visit_tables.is_table_of_visits(path)
    return visit_tables.read(path, bands, "science")


def without_place(rows):
    return [{**{n: getattr(row, n) for n in row.__slots__}, "location": ""} for row in rows]


def test_all_formats_have_the_same_visits(tmp_path, table):
    expected = read(FILE)
    assert len(expected) == 20
    pq.write_table(pa.table(table), tmp_path / "visits.parquet")
    for path in (
        write_sqlite(tmp_path / "visits.db", table),
        write_sqlite(tmp_path / "old.sqlite", table, "SummaryAllProps"),
        tmp_path / "visits.parquet",
    ):
        assert without_place(read(path)) == without_place(expected)
    first = expected[0]
    assert (first.band, first.ra, first.dec, first.mjd) == ("lsst_i", 65.109021, -33.455204, 60251.149007)
    assert (first.exposure_time_s, first.visit.exposures, first.visit.overhead_s) == (15.0, 2, 2.0)
    assert (first.visit.rot_sky, first.visit.rot_tel, first.visit.parallactic) == (156.08868, 60.352087, 264.263407)


def test_newer_tables_name_the_physical_filter_too(tmp_path, table):
    new = {**table, "band": table["filter"], "filter": [f"{name}_57" for name in table["filter"]]}
    assert [row.band for row in read(write_csv(tmp_path / "new.csv", new))] == [row.band for row in read(FILE)]
    del new["band"]
    assert [row.band for row in read(write_csv(tmp_path / "new.csv", new))] == [row.band for row in read(FILE)]


def test_names_of_columns_may_be_in_quotes(tmp_path, table):
    quoted = {f'"{name}"': values for name, values in table.items()}
    assert without_place(read(write_csv(tmp_path / "visits.csv", quoted))) == without_place(read(FILE))


def test_tables_of_pointings_are_not_visits(tmp_path):
    path = tmp_path / "pointings.csv"
    path.write_text("# fieldRA\nra,dec\n1,2\n")
    assert not visit_tables.is_table_of_visits(path)


@pytest.mark.parametrize("name", [name for name in NAMES if name != "rotSkyPos"])
def test_missing_columns_are_named(tmp_path, table, name):
    rest = {key: values for key, values in table.items() if key != name}
    with pytest.raises(BadInput, match=f"column {name} is missing from the table of visits") as caught:
        read(write_csv(tmp_path / "visits.csv", rest))
    assert len(caught.value.messages) == 1


def test_a_table_needs_an_angle(tmp_path, table):
    rest = {key: values for key, values in table.items() if not key.startswith("rot")}
    with pytest.raises(BadInput, match="column rotSkyPos or rotTelPos is missing"):
        read(write_csv(tmp_path / "visits.csv", rest))


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("filter", "w", "row 1: filter 'w' is unknown: "),
        ("filter", "VR", "row 1: filter 'VR' is unknown: "),
        ("fieldDec", 91.0, "column fieldDec of row 1 is 91"),
        ("airmass", 0.0, "column airmass of row 1 is 0"),
        ("numExposures", 1.5, "row 1: numExposures = 1.5 is not a whole number"),
        ("skyBrightness", "bright", "column skyBrightness of row 1 is 'bright'"),
        ("rotTelPos", 700.0, "column rotTelPos of row 1 is 700"),
        ("seeingFwhmEff", "nan", "column seeingFwhmEff of row 1 is NaN"),
    ],
)
def test_wrong_values_are_one_line(tmp_path, table, column, value, words):
    changed = {**table, column: [value, *table[column][1:]]}
    with pytest.raises(BadInput, match=r"visits\.csv") as caught:
        read(write_csv(tmp_path / "visits.csv", changed))
    assert words in str(caught.value)
    assert len(caught.value.messages) == 1


def test_damaged_files_are_one_line(tmp_path, table):
    whole = write_sqlite(tmp_path / "whole.db", table).read_bytes()
    cases = {
        "text.db": (b"fieldRA,fieldDec\n", "is not a SQLite file"),
        "cut.db": (whole[:5000], "is damaged: it has 5000 of "),
        "noise.db": (whole[:100] + b"\xff" * (len(whole) - 100), "malformed"),
        "empty.db": (b"", "is not a SQLite file"),
        "text.parquet": (b"fieldRA,fieldDec\n", "is not a parquet file"),
        "cut.parquet": (b"PAR1" + b"\0" * 100, "is not a Parquet file"),
    }
    for name, (content, words) in cases.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(BadInput, match=name.replace(".", r"\.")) as caught:
            read(tmp_path / name)
        assert words in str(caught.value)
        assert len(caught.value.messages) == 1
    with pytest.raises(BadInput, match="has no table observations or SummaryAllProps: it has visits"):
        read(write_sqlite(tmp_path / "other.db", table, "visits"))
    with pytest.raises(BadInput, match="contains no visits"):
        read(write_csv(tmp_path / "none.csv", {name: [] for name in table}))
