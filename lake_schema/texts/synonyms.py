"""Names that other catalogues and users have for tables and columns of truesky, from synonyms.csv.

The names `given_galaxies` and `given_stars` stand for a user's tables of sources (section `sources` of a request).
"""

from __future__ import annotations

import csv
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from lake_schema.texts import spelling

# Tables whose synonyms are compared with the titles of a user's catalogue.
_CATALOGUES = ("given_galaxies", "given_stars", "galaxies", "stars", "halos")
_FILE = Path(__file__).with_name("synonyms.csv")


@dataclass(frozen=True, slots=True)
class Synonym:
    """Meaning of a name: a table, a column ("" if the name means the table), and a phrase that explains the column."""

    table: str
    column: str
    meaning: str


@lru_cache(maxsize=1)
def load_synonyms() -> Mapping[str, Sequence[Synonym]]:
    """Return the meanings of each name. Names are in lower case."""
    synonyms: dict[str, list[Synonym]] = {}
    with _FILE.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            for name in row["names"].split():
                targets = [Synonym(table, row["column"], row["meaning"]) for table in row["tables"].split()]
                synonyms.setdefault(name, []).extend(targets)
    return synonyms


def find_columns(name: str, tables: Sequence[str], columns: Container[str]) -> list[str]:
    """Return the columns that a name in a user's table can mean, [] if none is known.

    Parameters
    ----------
    name : str
        Name of a column. Upper and lower case are the same.
    tables : sequence of str
        Tables whose synonyms are compared; the first one with a suitable column is used.
    columns : container of str
        Names of the columns that are allowed.

    Returns
    -------
    list of str
        Names of the columns, such as gamma1 and gamma2 for "shear".
    """
    synonyms = load_synonyms().get(name.lower(), ())
    for table in tables:
        if names := [meant.column for meant in synonyms if meant.table == table and meant.column in columns]:
            return names
    return []


def suggest_title(column: str, titles: Sequence[str]) -> str:
    """Return " (did you mean X?)" with the title in a file that a missing column may have, "" if none is known.

    It is the most similar title, or one that means the column, such as RAJ2000 for ra.
    """
    if similar := spelling.suggestion(column, titles):
        return similar
    meant = [title for title in titles if find_columns(title, _CATALOGUES, [column.lower()])]
    return f" (did you mean {meant[0]}?)" if meant else ""
