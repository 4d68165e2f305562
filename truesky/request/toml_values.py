"""Values of a parsed TOML table, each refused with its key's full path where it is not what is wanted."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, cast

from lake_schema.errors import BadInput, OutOfRange

Toml = Mapping[str, Any]


def check_keys(table: Toml, path: str, keys: set[str]) -> None:
    """Refuse a table with any other key."""
    unknown = sorted(set(table) - keys)
    if unknown:
        key_path = f"{path}.{unknown[0]}" if path else unknown[0]
        raise BadInput(f"{key_path} is not a key of a request; known here: {', '.join(sorted(keys))}")


def section(table: Toml, key: str, keys: set[str] | None) -> Toml:
    """The sub-table of a key, empty where it is not there."""
    return as_table(table.get(key, {}), key, keys)


def as_table(value: object, path: str, keys: set[str] | None) -> Toml:
    """A value that must be a table, of these keys only."""
    if not isinstance(value, dict):
        raise BadInput(f"{path} wants a table, got {quote_value(value)}")
    if keys is not None:
        check_keys(value, path, keys)
    return cast(Toml, value)


def table_list(table: Toml, key: str, max_tables: int) -> list[object]:
    """A list of at most `most` tables, empty where it is not there."""
    entries = table.get(key, [])
    if not isinstance(entries, list) or len(entries) > max_tables:
        raise BadInput(f"{key} wants a list of at most {max_tables} tables")
    return entries


def has_key(table: Toml, path: str) -> bool:
    """Is the key there?"""
    return path.rpartition(".")[2] in table


def required_value(table: Toml, path: str) -> object:
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
    if default is not None and not has_key(table, path):
        return default
    text = required_value(table, path)
    if not isinstance(text, str):
        raise BadInput(f"{path} wants text, got {quote_value(text)}")
    if legal and text not in legal:
        raise BadInput(f"{path} = {quote_value(text)} is not one of {', '.join(legal)}")
    return text


def strings(table: Toml, path: str, legal: Sequence[str] = (), distinct: bool = True) -> tuple[str, ...]:
    """A list of texts, empty where it is not there.

    table, path : as of `string`;  legal : texts that are allowed, none = all
    distinct    : whether a text that stands twice is refused
    """
    texts = table.get(path.rpartition(".")[2], [])
    if not isinstance(texts, list) or not all(isinstance(item, str) for item in texts):
        raise BadInput(f"{path} wants a list of texts, got {quote_value(texts)}")
    for item in texts:
        if legal and item not in legal:
            raise BadInput(f"{path}: {quote_value(item)} is not one of {', '.join(legal)}")
    if distinct and len(set(texts)) != len(texts):
        raise BadInput(f"{path} = {quote_value(texts)} names something twice")
    return tuple(texts)


def number(table: Toml, path: str, lo: float, hi: float, default: float | None = None) -> float:
    """A finite number from lo to hi.

    table, path : as of `string`;  lo, hi : both still allowed
    default     : where the key is not there, None = it has to be
    """
    if default is not None and not has_key(table, path):
        return default
    return checked_number(required_value(table, path), path, lo, hi)


def optional_number(table: Toml, path: str, lo: float, hi: float) -> float | None:
    """The same, None where the key is not there.

    table, path, lo, hi : as of `number`
    """
    return number(table, path, lo, hi) if has_key(table, path) else None


def checked_number(value: object, path: str, lo: float, hi: float) -> float:
    """A value that must be a finite number from lo to hi.

    found : what stands in the request;  path : the key's name;  lo, hi : both still allowed
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise BadInput(f"{path} wants a number, got {quote_value(value)}")
    # Whole numbers are compared before they become floats: TOML's have no largest one.
    if not lo <= value <= hi or not math.isfinite(value):
        raise OutOfRange(path, quote_value(value), lo, hi)
    return float(value)


def integer(table: Toml, path: str, lo: int, hi: int, default: int | None = None) -> int:
    """A whole number from lo to hi.

    table, path, lo, hi, default : as of `number`
    """
    if default is not None and not has_key(table, path):
        return default
    integer_value = required_value(table, path)
    if isinstance(integer_value, bool) or not isinstance(integer_value, int):
        raise BadInput(f"{path} wants a whole number, got {quote_value(integer_value)}")
    if not lo <= integer_value <= hi:
        raise OutOfRange(path, quote_value(integer_value), lo, hi)
    return integer_value


def boolean(table: Toml, path: str, default: bool) -> bool:
    """true or false."""
    flag = table.get(path.rpartition(".")[2], default)
    if not isinstance(flag, bool):
        raise BadInput(f"{path} wants true or false, got {quote_value(flag)}")
    return flag


def integer_choice(table: Toml, path: str, legal: Sequence[int], default: int) -> int:
    """One of a few whole numbers.

    table, path : as of `string`;  legal : numbers that are allowed;  default : where the key is not there
    """
    selected = integer(table, path, min(legal), max(legal), default)
    if selected not in legal:
        raise BadInput(f"{path} = {selected} is not one of {', '.join(map(str, legal))}")
    return selected


def number_pair(table: Toml, path: str, lo: float, hi: float) -> tuple[float, float]:
    """Two numbers.

    table, path, lo, hi : as of `number`, lo and hi of each of the two
    """
    numbers = required_value(table, path)
    if not isinstance(numbers, list) or len(numbers) != 2:
        raise BadInput(f"{path} wants [from, to], got {quote_value(numbers)}")
    first, second = (checked_number(item, path, lo, hi) for item in numbers)
    return first, second


def quote_value(value: object) -> str:
    """A value as it is quoted in a message, never long."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
