"""Read and check values of a parsed TOML table. Errors name the full path of the key.

The parameter `path` of these functions is the name of a key with its sections, for example "universe.z_max".
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, cast

from lake_schema.errors import BadInput, OutOfRange

Toml = Mapping[str, Any]


def check_keys(table: Toml, path: str, keys: set[str]) -> None:
    """Check that a table has no unknown keys.

    Parameters
    ----------
    table : Toml
        The table.
    path : str
        Path of the table; "" for the whole request.
    keys : set of str
        Keys that are allowed.

    Raises
    ------
    BadInput
        If the table has another key.
    """
    unknown = sorted(set(table) - keys)
    if unknown:
        key_path = f"{path}.{unknown[0]}" if path else unknown[0]
        raise BadInput(f"{key_path} is not a key of a request; allowed here: {', '.join(sorted(keys))}")


def section(table: Toml, key: str, keys: set[str] | None) -> Toml:
    """Return the table of a key, empty if the key is missing.

    Parameters
    ----------
    table : Toml
        The table with the key.
    key : str
        Name of the key.
    keys : set of str or None
        Keys that are allowed in the table; None for all.

    Returns
    -------
    Toml
        The table of the key.

    Raises
    ------
    BadInput
        If the value is not a table, or has another key.
    """
    return as_table(table.get(key, {}), key, keys)


def as_table(value: object, path: str, keys: set[str] | None) -> Toml:
    """Return a value that must be a table.

    Parameters
    ----------
    value : object
        The value.
    path : str
        Path of the key.
    keys : set of str or None
        Keys that are allowed in the table; None for all.

    Returns
    -------
    Toml
        The value.

    Raises
    ------
    BadInput
        If the value is not a table, or has another key.
    """
    if not isinstance(value, dict):
        raise BadInput(f"{path} must be a table, got {quote_value(value)}")
    if keys is not None:
        check_keys(value, path, keys)
    return cast(Toml, value)


def table_list(table: Toml, key: str, max_tables: int) -> list[object]:
    """Return the list of a key, empty if the key is missing.

    Parameters
    ----------
    table : Toml
        The table with the key.
    key : str
        Name of the key.
    max_tables : int
        Largest length of the list.

    Returns
    -------
    list of object
        The list. Its items are not checked.

    Raises
    ------
    BadInput
        If the value is not a list, or is too long.
    """
    entries = table.get(key, [])
    if not isinstance(entries, list) or len(entries) > max_tables:
        raise BadInput(f"{key} must be a list of at most {max_tables} tables")
    return entries


def has_key(table: Toml, path: str) -> bool:
    """Return True if the table has the key at the end of `path`."""
    return path.rpartition(".")[2] in table


def required_value(table: Toml, path: str) -> object:
    """Return the value of a key; raises BadInput if the key is missing."""
    key = path.rpartition(".")[2]
    if key not in table:
        raise BadInput(f"{path} is missing")
    return table[key]


def string(table: Toml, path: str, legal: Sequence[str] = (), default: str | None = None) -> str:
    """Return a text.

    Parameters
    ----------
    table : Toml
        Section with the key.
    path : str
        Path of the key.
    legal : sequence of str, optional
        Texts that are allowed; all if empty.
    default : str, optional
        Value if the key is missing; None if the key is required.

    Returns
    -------
    str
        The text.

    Raises
    ------
    BadInput
        If the key is missing without a default, or the value is not an allowed text.
    """
    if default is not None and not has_key(table, path):
        return default
    text = required_value(table, path)
    if not isinstance(text, str):
        raise BadInput(f"{path} must be text, got {quote_value(text)}")
    if legal and text not in legal:
        raise BadInput(f"{path} = {quote_value(text)} is not one of {', '.join(legal)}")
    return text


def strings(table: Toml, path: str, legal: Sequence[str] = (), distinct: bool = True) -> tuple[str, ...]:
    """Return a list of texts, empty if the key is missing.

    Parameters
    ----------
    table : Toml
        Section with the key.
    path : str
        Path of the key.
    legal : sequence of str, optional
        Texts that are allowed; all if empty.
    distinct : bool, optional
        If True, no text may occur twice.

    Returns
    -------
    tuple of str
        The texts.

    Raises
    ------
    BadInput
        If the value is not a list of allowed texts, or contains a text twice.
    """
    texts = table.get(path.rpartition(".")[2], [])
    if not isinstance(texts, list) or not all(isinstance(item, str) for item in texts):
        raise BadInput(f"{path} must be a list of texts, got {quote_value(texts)}")
    for item in texts:
        if legal and item not in legal:
            raise BadInput(f"{path}: {quote_value(item)} is not one of {', '.join(legal)}")
    if distinct and len(set(texts)) != len(texts):
        raise BadInput(f"{path} = {quote_value(texts)} contains a text twice")
    return tuple(texts)


def number(table: Toml, path: str, lo: float, hi: float, default: float | None = None) -> float:
    """Return a finite number.

    Parameters
    ----------
    table : Toml
        Section with the key.
    path : str
        Path of the key.
    lo, hi : float
        Limits, both allowed.
    default : float, optional
        Value if the key is missing; None if the key is required.

    Returns
    -------
    float
        The number.

    Raises
    ------
    BadInput
        If the key is missing without a default, or the value is not a number.
    OutOfRange
        If the number is outside its limits.
    """
    if default is not None and not has_key(table, path):
        return default
    return checked_number(required_value(table, path), path, lo, hi)


def optional_number(table: Toml, path: str, lo: float, hi: float) -> float | None:
    """Return a finite number, or None if the key is missing.

    Parameters
    ----------
    table : Toml
        Section with the key.
    path : str
        Path of the key.
    lo, hi : float
        Limits, both allowed.

    Returns
    -------
    float or None
        The number.

    Raises
    ------
    BadInput
        If the value is not a number.
    OutOfRange
        If the number is outside its limits.
    """
    return number(table, path, lo, hi) if has_key(table, path) else None


def checked_number(value: object, path: str, lo: float, hi: float) -> float:
    """Return a value that must be a finite number.

    Parameters
    ----------
    value : object
        Value in the request.
    path : str
        Path of the key.
    lo, hi : float
        Limits, both allowed.

    Returns
    -------
    float
        The number.

    Raises
    ------
    BadInput
        If the value is not a number.
    OutOfRange
        If the number is outside its limits.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise BadInput(f"{path} must be a number, got {quote_value(value)}")
    # Compare before the conversion to float: whole numbers in TOML have no upper limit.
    if not lo <= value <= hi or not math.isfinite(value):
        raise OutOfRange(path, quote_value(value), lo, hi)
    return float(value)


def integer(table: Toml, path: str, lo: int, hi: int, default: int | None = None) -> int:
    """Return a whole number.

    Parameters
    ----------
    table : Toml
        Section with the key.
    path : str
        Path of the key.
    lo, hi : int
        Limits, both allowed.
    default : int, optional
        Value if the key is missing; None if the key is required.

    Returns
    -------
    int
        The number.

    Raises
    ------
    BadInput
        If the key is missing without a default, or the value is not a whole number.
    OutOfRange
        If the number is outside its limits.
    """
    if default is not None and not has_key(table, path):
        return default
    integer_value = required_value(table, path)
    if isinstance(integer_value, bool) or not isinstance(integer_value, int):
        raise BadInput(f"{path} must be a whole number, got {quote_value(integer_value)}")
    if not lo <= integer_value <= hi:
        raise OutOfRange(path, quote_value(integer_value), lo, hi)
    return integer_value


def boolean(table: Toml, path: str, default: bool) -> bool:
    """Return true or false.

    Parameters
    ----------
    table : Toml
        Section with the key.
    path : str
        Path of the key.
    default : bool
        Value if the key is missing.

    Returns
    -------
    bool
        The value.

    Raises
    ------
    BadInput
        If the value is not a boolean.
    """
    flag = table.get(path.rpartition(".")[2], default)
    if not isinstance(flag, bool):
        raise BadInput(f"{path} must be true or false, got {quote_value(flag)}")
    return flag


def integer_choice(table: Toml, path: str, legal: Sequence[int], default: int) -> int:
    """Return one of a few whole numbers.

    Parameters
    ----------
    table : Toml
        Section with the key.
    path : str
        Path of the key.
    legal : sequence of int
        Numbers that are allowed.
    default : int
        Value if the key is missing.

    Returns
    -------
    int
        The number.

    Raises
    ------
    BadInput
        If the value is not one of the allowed numbers.
    """
    selected = integer(table, path, min(legal), max(legal), default)
    if selected not in legal:
        raise BadInput(f"{path} = {selected} is not one of {', '.join(map(str, legal))}")
    return selected


def number_pair(table: Toml, path: str, lo: float, hi: float) -> tuple[float, float]:
    """Return two numbers.

    Parameters
    ----------
    table : Toml
        Section with the key.
    path : str
        Path of the key.
    lo, hi : float
        Limits of both numbers, both allowed.

    Returns
    -------
    (float, float)
        The numbers.

    Raises
    ------
    BadInput
        If the key is missing, or the value is not a list of two numbers.
    OutOfRange
        If a number is outside its limits.
    """
    numbers = required_value(table, path)
    if not isinstance(numbers, list) or len(numbers) != 2:
        raise BadInput(f"{path} must be [from, to], got {quote_value(numbers)}")
    first, second = (checked_number(item, path, lo, hi) for item in numbers)
    return first, second


def quote_value(value: object) -> str:
    """Return a value as text for a message, with at most 60 characters."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
