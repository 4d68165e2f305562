"""docs/ingest.md names every column that a shipped format reads."""

from pathlib import Path

from truesky.catalogue.external import mapping
from truesky.cosmology import FIDUCIAL

PAGE = Path(__file__).resolve().parents[4] / "docs" / "ingest.md"


def test_every_column_of_every_format_is_in_its_table():
    table = PAGE.read_text().split("## Columns of the formats")[1]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines() if line[:1] == "|"]
    found = {row[0].strip("`"): dict(zip(rows[0][1:], row[1:], strict=True)) for row in rows[2:]}
    for form in mapping.formats():
        columns = mapping.galaxy_columns(form, {}, FIDUCIAL)
        for key, field in columns.fields.items():
            assert [name for name in field.titles() if f"`{name}`" not in found[key][form]] == [], (form, key)
            assert field.unit in found[key][form]
        assert {key for key, row in found.items() if row[form]} == set(columns.fields)
