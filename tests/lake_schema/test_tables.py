"""The reference page, declarations by name, and the tables that record inputs: mission, templates, passbands."""

import hashlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest

from lake_schema import tables
from lake_schema.errors import BadInput
from lake_schema.mission import published
from lake_schema.mission.configuration import resolve
from lake_schema.mission.model import read_models
from lake_schema.mission.parameter import read_all_parameters
from lake_schema.store import publish, read
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.store.validate import check_rows
from lake_schema.tables import mission, passbands, stars, templates
from lake_schema.tables.common import Origin
from lake_schema.tables.exposures import EXPOSURES, ExposureRow
from truesky.commands import __main__
from truesky.fluxes import passbands as responses

# sha256 of the fields of table `stars` without variable stars; lakes of earlier versions contain it.
STARS_SCHEMA = "d883afb4bebdb48c5659d7e130fb18b412134f2552f7d67b31fc6b9903e7c19e"
PAGE = Path(__file__).resolve().parents[2] / "docs" / "tables.md"


def test_the_reference_page_is_up_to_date(capsys):
    """If this fails, run: truesky tables > docs/tables.md"""
    assert __main__.main(["tables"]) == 0
    assert PAGE.read_text() == capsys.readouterr().out


@pytest.mark.parametrize("variables", [False, True])
def test_tables_are_found_by_name(variables):
    for table in tables.all_tables(["euclid_vis", "lsst_r"], variables):
        assert tables.find_table(table.name, table.names) == table
    assert tables.find_table("nothing") is None


def test_variable_stars_add_nullable_columns_to_the_table_of_stars():
    """Without them, the table is the same as if the columns had never been declared."""
    plain, variable = stars.stars(False), stars.stars(True)
    assert plain == stars.STARS
    assert variable.columns[: len(plain.columns)] == plain.columns
    assert not {column.name for column in stars.VARIABILITY_COLUMNS} & set(plain.names)
    assert all(column.nullable for column in stars.VARIABILITY_COLUMNS)
    fields = [(f.name, str(f.type), f.nullable, sorted(f.metadata.items())) for f in plain.arrow_schema()]
    assert hashlib.sha256(repr(fields).encode()).hexdigest() == STARS_SCHEMA


def test_a_row_of_exposures_has_a_field_per_column():
    """The attributes have the order and the types of the columns; nullable ones may be None."""
    types = {"int64": int, "int32": int, "float64": float, "string": str}
    declared = {c.name: types[c.type] | None if c.nullable else types[c.type] for c in EXPOSURES.columns}
    assert list(get_type_hints(ExposureRow).items()) == list(declared.items())
    row = {name: number for number, name in enumerate(declared)}
    assert asdict(ExposureRow.from_row({**row, "another": 0})) == row
    with pytest.raises(KeyError, match="survey"):
        ExposureRow.from_row({name: value for name, value in row.items() if name != "survey"})


@dataclass
class Types:
    teff: np.ndarray
    log_g: np.ndarray


@dataclass
class Library:
    wavelength: np.ndarray
    flux: np.ndarray
    names: tuple
    types: Types | None = None


def libraries():
    rng = np.random.default_rng(1)
    wavelength = np.arange(600.0, 700.0)
    spectra = rng.random((3, 100)).astype(np.float32)
    known = Types(np.array([40_000.0, 5_000.0]), np.array([4.0, 4.5]))
    return {
        "galaxy": Library(wavelength, spectra[:2], ("E", "Im")),
        "star": Library(wavelength, spectra, ("O9V", "G2V", "T5"), known),
    }


def origins():
    return {
        name: [Origin(f"{name}{k}.sed", "0" * 64) for k in range(len(library.names))]
        for name, library in libraries().items()
    }


def test_templates_come_back_as_spectra():
    rows = templates.rows(libraries(), origins())
    check_rows(rows, templates.TEMPLATES)
    assert rows["sed"].to_pylist() == [0, 1, 0, 1, 2]
    assert rows["teff"].to_pylist() == [None, None, 40_000.0, 5_000.0, None]
    assert rows["log_g"].to_pylist() == [None, None, 4.0, 4.5, None]
    for library in libraries().values():
        for i, name in enumerate(library.names):
            row = next(row for row in rows.to_pylist() if row["name"] == name)
            assert row["sed"] == i
            assert row["source"].endswith(f"{i}.sed")
            assert np.array_equal(np.array(row["flux"], np.float32), library.flux[i])
            assert np.array_equal(row["first_wavelength"] + row["wavelength_step"] * np.arange(100), library.wavelength)


def test_passbands_come_back_as_responses():
    bands = [responses.load(name) for name in ("euclid_vis", "lsst_r")]
    pivots, widths = [responses.pivot_wavelength(b) for b in bands], [responses.log_width(b) for b in bands]
    rows = passbands.rows(bands, pivots, widths, [Origin(b.name, "0" * 64) for b in bands], [-0.1, None])
    check_rows(rows, passbands.PASSBANDS)
    assert rows["ab_minus_vega"].to_pylist() == [-0.1, None]
    assert rows["source"].to_pylist() == ["euclid_vis", "lsst_r"]
    for band, row in zip(bands, rows.to_pylist(), strict=True):
        assert row["name"] == band.name
        assert row["medium"] == band.medium
        assert np.array_equal(row["response"], band.response)
        assert row["first_wavelength"] + row["wavelength_step"] * (len(row["response"]) - 1) == band.wavelength[-1]
        assert 4000 < row["pivot_wavelength"] < 10_000
    with pytest.raises(BadInput, match="medium"):
        check_rows(passbands.rows([Other()], [5000.0], [0.1], [Origin("x", "")], [None]), passbands.PASSBANDS)


class Other:
    name, medium, wavelength, response = "x", "water", np.arange(10.0) + 100, np.ones(10)


def test_the_mission_with_what_a_run_chose():
    name = next(p.key for p in read_all_parameters() if p.unit == "electron")
    plain, changed = resolve(), resolve(overrides={name: (7.5, "electron")})
    for chosen, given in ((plain, 0), (changed, 1)):
        rows = published.to_table(chosen)
        check_rows(rows, mission.MISSION)
        assert rows.num_rows == len(read_all_parameters()) + len(read_models()) + given
        used = [row for row in rows.to_pylist() if row["chosen"]]
        assert sorted(row["name"] for row in used) == sorted(r.key for r in (*chosen.parameters, *chosen.models))
        values = {row["name"]: (row["value"], row["unit"]) for row in used if row["file"] is None}
        assert values == {p.key: (p.value, p.unit) for p in chosen.parameters}
        files = {row["name"]: row["sha256"] for row in used if row["value"] is None}
        assert files == {m.key: m.sha256 for m in chosen.models}
        assert [row["value"] for row in used if row["overridden"]] == [7.5] * given


def test_all_tables_can_be_published_and_queried(lake):
    for table, rows in (
        (templates.TEMPLATES, templates.rows(libraries(), origins())),
        (mission.MISSION, published.to_table(resolve())),
    ):
        publish.make_version(
            lake, Plan(table, {}, (Task("0.parquet", {}),)), lambda root, facts, rows=rows: Output(rows)
        )
        assert read.version(lake, table.name).rows().equals(rows)
