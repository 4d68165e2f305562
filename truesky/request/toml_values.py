"""Values of a parsed TOML table, each refused with its key's full path where it is not what is wanted."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, cast

from lake_schema.errors import BadInput, OutOfRange

Toml = Mapping[str, Any]


def known(table: Toml, path: str, keys: set[str]) -> None:
    """Refuse a table with any other key."""
    unknown = sorted(set(table) - keys)
    if unknown:
        where = f"{path}.{unknown[0]}" if path else unknown[0]
        raise BadInput(f"{where} is not a key of a request; known here: {', '.join(sorted(keys))}")


def section(table: Toml, key: str, keys: set[str] | None) -> Toml:
    """The sub-table of a key, empty where it is not there."""
    return table_of(table.get(key, {}), key, keys)


def table_of(value: object, path: str, keys: set[str] | None) -> Toml:
    """A value that must be a table, of these keys only."""
    if not isinstance(value, dict):
        raise BadInput(f"{path} wants a table, got {shown(value)}")
    if keys is not None:
        known(value, path, keys)
    return cast(Toml, value)


def tables(table: Toml, key: str, most: int) -> list[object]:
    """A list of at most `most` tables, empty where it is not there."""
    found = table.get(key, [])
    if not isinstance(found, list) or len(found) > most:
        raise BadInput(f"{key} wants a list of at most {most} tables")
    return found


def has(table: Toml, path: str) -> bool:
    """Is the key there?"""
    return path.rpartition(".")[2] in table


def value(table: Toml, path: str) -> object:
    """Whatever stands at a key that must be there."""
    key = path.rpartition(".")[2]
    if key not in table:
        raise BadInput(f"{path} is missing")
    return table[key]


def string(table: Toml, path: str, legal: Sequence[str] = (), default: str | None = None) -> str:
    """A text, one of `legal` where some are named.

    table, path : a section, and the key's name with its sections' names
    legal       : texts that are allowed, none = all;  default : where the key is not there, None = it has to be
    """
    if default is not None and not has(table, path):
        return default
    found = value(table, path)
    if not isinstance(found, str):
        raise BadInput(f"{path} wants text, got {shown(found)}")
    if legal and found not in legal:
        raise BadInput(f"{path} = {shown(found)} is not one of {', '.join(legal)}")
    return found


def strings(table: Toml, path: str, legal: Sequence[str] = (), distinct: bool = True) -> tuple[str, ...]:
    """A list of texts, empty where it is not there.

    table, path : as of `string`;  legal : texts that are allowed, none = all
    distinct    : whether a text that stands twice is refused
    """
    found = table.get(path.rpartition(".")[2], [])
    if not isinstance(found, list) or not all(isinstance(item, str) for item in found):
        raise BadInput(f"{path} wants a list of texts, got {shown(found)}")
    for item in found:
        if legal and item not in legal:
            raise BadInput(f"{path}: {shown(item)} is not one of {', '.join(legal)}")
    if distinct and len(set(found)) != len(found):
        raise BadInput(f"{path} = {shown(found)} names something twice")
    return tuple(found)


def number(table: Toml, path: str, lo: float, hi: float, default: float | None = None) -> float:
    """A finite number from lo to hi.

    table, path : as of `string`;  lo, hi : both still allowed
    default     : where the key is not there, None = it has to be
    """
    if default is not None and not has(table, path):
        return default
    return checked_number(value(table, path), path, lo, hi)


def optional(table: Toml, path: str, lo: float, hi: float) -> float | None:
    """The same, None where the key is not there.

    table, path, lo, hi : as of `number`
    """
    return number(table, path, lo, hi) if has(table, path) else None


def checked_number(found: object, path: str, lo: float, hi: float) -> float:
    """A value that must be a finite number from lo to hi.

    found : what stands in the request;  path : the key's name;  lo, hi : both still allowed
    """
    if isinstance(found, bool) or not isinstance(found, (int, float)):
        raise BadInput(f"{path} wants a number, got {shown(found)}")
    # Whole numbers are compared before they become floats: TOML's have no largest one.
    if not lo <= found <= hi or not math.isfinite(found):
        raise OutOfRange(path, shown(found), lo, hi)
    return float(found)


def integer(table: Toml, path: str, lo: int, hi: int, default: int | None = None) -> int:
    """A whole number from lo to hi.

    table, path, lo, hi, default : as of `number`
    """
    if default is not None and not has(table, path):
        return default
    found = value(table, path)
    if isinstance(found, bool) or not isinstance(found, int):
        raise BadInput(f"{path} wants a whole number, got {shown(found)}")
    if not lo <= found <= hi:
        raise OutOfRange(path, shown(found), lo, hi)
    return found


def boolean(table: Toml, path: str, default: bool) -> bool:
    """true or false."""
    found = table.get(path.rpartition(".")[2], default)
    if not isinstance(found, bool):
        raise BadInput(f"{path} wants true or false, got {shown(found)}")
    return found


def choice(table: Toml, path: str, legal: Sequence[int], default: int) -> int:
    """One of a few whole numbers.

    table, path : as of `string`;  legal : numbers that are allowed;  default : where the key is not there
    """
    found = integer(table, path, min(legal), max(legal), default)
    if found not in legal:
        raise BadInput(f"{path} = {found} is not one of {', '.join(map(str, legal))}")
    return found


def pair(table: Toml, path: str, lo: float, hi: float) -> tuple[float, float]:
    """Two numbers.

    table, path, lo, hi : as of `number`, lo and hi of each of the two
    """
    found = value(table, path)
    if not isinstance(found, list) or len(found) != 2:
        raise BadInput(f"{path} wants [from, to], got {shown(found)}")
    first, second = (checked_number(item, path, lo, hi) for item in found)
    return first, second


def shown(found: object) -> str:
    """A value as it is quoted in a message, never long."""
    text = repr(found)
    return text if len(text) <= 60 else text[:57] + "..."
