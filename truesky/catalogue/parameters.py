"""Numbers of the models, read from the data files beside the modules; each of their tables has a source."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from lake_schema import user_files
from lake_schema.errors import BadInput

_FOLDER = Path(__file__).resolve().parent


def section(file: str, name: str) -> dict[str, Any]:
    """One table of a TOML file of this folder, without its `source`: the arguments of a dataclass.

    Errors: BadInput where the table is absent or has no source
    """
    tables = _tables((_FOLDER / file).read_text(encoding="utf-8"))
    if name not in tables:
        raise BadInput(f"{file} has no table [{name}]")
    numbers = dict(tables[name])
    if not str(numbers.pop("source", "")).strip():
        raise BadInput(f"{file}: table [{name}] states no source")
    return {key: tuple(value) if isinstance(value, list) else value for key, value in numbers.items()}


@cache
def _tables(text: str) -> dict[str, Any]:
    """The tables of a file's text: a model reads dozens of tables from a few files."""
    return user_files.parse_toml(text)
