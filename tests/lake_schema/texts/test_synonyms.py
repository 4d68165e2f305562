"""Synonyms of names of tables and columns."""

import pytest

from lake_schema.tables import all_tables
from lake_schema.texts import synonyms
from truesky.catalogue import given_sources

TABLES = {table.name: list(table.names) for table in all_tables(["euclid_vis"])}
GIVEN = {
    "given_galaxies": [*given_sources.GALAXIES, "ra", "dec", "axis_ratio", "half_light_radius", "e1", "e2"],
    "given_stars": [*given_sources.STARS, "ra", "dec"],
}


def test_targets_of_all_synonyms_exist():
    names = synonyms.load_synonyms()
    assert len(names) > 300
    for name, targets in names.items():
        for target in targets:
            columns = {**TABLES, **GIVEN}[target.table]
            assert target.column in [*columns, ""]
            assert bool(target.meaning) == bool(target.column)
            # A name that exists needs no synonym.
            assert name not in (columns if target.column else TABLES)


@pytest.mark.parametrize(
    ("name", "column"),
    [
        ("r_e", "half_light_radius"), ("re", "half_light_radius"), ("HLR", "half_light_radius"),
        ("n", "bulge_sersic_index"), ("sersic", "bulge_sersic_index"), ("sersic_n", "bulge_sersic_index"),
        ("magnitude", "mag"), ("RAJ2000", "ra"), ("DEJ2000", "dec"), ("q", "axis_ratio"), ("pa", "position_angle"),
        ("ellipticity1", "e1"), ("z", "z_true"), ("g1", "gamma1"), ("bt", "bulge_fraction"),
    ],
)  # fmt: skip
def test_columns_of_added_galaxies(name, column):
    assert synonyms.find_columns(name, ("given_galaxies", "galaxies"), GIVEN["given_galaxies"]) == [column]


def test_names_without_a_meaning():
    assert synonyms.find_columns("foo", ("given_galaxies", "galaxies"), GIVEN["given_galaxies"]) == []
    assert synonyms.find_columns("n", ("given_stars", "stars"), GIVEN["given_stars"]) == []


def test_a_name_with_two_meanings():
    assert synonyms.find_columns("shear", ("galaxies",), GIVEN["given_galaxies"]) == ["gamma1", "gamma2"]
