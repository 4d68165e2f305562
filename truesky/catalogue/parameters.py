"""Read the parameters of the catalogue models from the TOML files in this folder; each TOML table names its source."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from lake_schema import user_files
from lake_schema.errors import BadInput

_FOLDER = Path(__file__).resolve().parent


def section(file: str, name: str) -> dict[str, Any]:
    """Return a table of a TOML file in this folder without its key `source`.

    Parameters
    ----------
    file : str
        Name of the file.
    name : str
        Name of the table.

    Returns
    -------
    dict
        Values of the table by key, which can be passed to a dataclass as arguments; arrays become tuples.

    Raises
    ------
    BadInput
        If the table does not exist, or if its `source` is missing or empty.
    """
    tables = _tables((_FOLDER / file).read_text(encoding="utf-8"))
    if name not in tables:
        raise BadInput(f"{file} has no table [{name}]")
    numbers = dict(tables[name])
    if not str(numbers.pop("source", "")).strip():
        raise BadInput(f"{file}: table [{name}] must have a key source")
    return {key: tuple(value) if isinstance(value, list) else value for key, value in numbers.items()}


@cache
def _tables(text: str) -> dict[str, Any]:
    """Parse the text of a TOML file; the result is cached, because a model reads dozens of tables from a few files."""
    return user_files.parse_toml(text)
