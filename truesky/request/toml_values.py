"""Read and check values of a parsed TOML table, a request (the file in which a user describes a simulation).

Error messages name the full path of the key. The parameter `path` of these functions is the name of a key with its
sections, for example "universe.z_max". The function looks for the last part, here "z_max", in the table of the section.
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
        The table of a section.
    path : str
        Name of the section with the sections around it, for the error message; "" for the whole request.
    keys : set of str
        Keys that are allowed. They need not be present.

    Raises
    ------
    BadInput
        If the table has another key. The message names the first one.
    """
    unknown = sorted(set(table) - keys)
    if unknown:
        key_path = f"{path}.{unknown[0]}" if path else unknown[0]
        raise BadInput(f"{key_path} is not a key of a request; allowed here: {', '.join(sorted(keys))}")


def section(table: Toml, key: str, keys: set[str] | None) -> Toml:
    """Return a section of a request as a table, empty if the section is missing.

    Parameters
    ----------
    table : Toml
        Table that contains the section, such as the whole request.
    key : str
        Name of the section.
    keys : set of str or None
        Keys that are allowed in the section; None for any.

    Returns
    -------
    Toml
        The table of the section.

    Raises
    ------
    BadInput
        If the value is not a table, or the section has another key.
    """
    return as_table(table.get(key, {}), key, keys)


def as_table(value: object, path: str, keys: set[str] | None) -> Toml:
    """Check that a value is a table, and return it.

    Parameters
    ----------
    value : object
        Value of a key in the request.
    path : str
        Path of the key, for error messages.
    keys : set of str or None
        Keys that are allowed in the table; None for any.

    Returns
    -------
    Toml
        The value.

    Raises
    ------
    BadInput
        If the value is not a table, or the table has another key.
    """
    if not isinstance(value, dict):
        raise BadInput(f"{path} must be a table, got {quote_value(value)}")
    if keys is not None:
        check_keys(value, path, keys)
    return cast(Toml, value)


def table_list(table: Toml, key: str, max_tables: int) -> list[object]:
    """Return a list of tables, such as [[pointing]] in TOML, empty if the key is missing.

    Parameters
    ----------
    table : Toml
        Table with the key.
    key : str
        Name of the key.
    max_tables : int
        Largest length of the list.

    Returns
    -------
    list of object
        The list. It is not checked that its items are tables.

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
    """Return True if the table has the key at the end of `path`: "z_max" for "universe.z_max"."""
    return path.rpartition(".")[2] in table


def required_value(table: Toml, path: str) -> object:
    """Return the value of the key at the end of `path`, of any type; raises BadInput if the table has no such key."""
    key = path.rpartition(".")[2]
    if key not in table:
        raise BadInput(f"{path} is missing")
    return table[key]


def string(table: Toml, path: str, legal: Sequence[str] = (), default: str | None = None) -> str:
    """Read the value of a key that must be text.

    Parameters
    ----------
    table : Toml
        Table of the section with the key.
    path : str
        Path of the key.
    legal : sequence of str, optional
        Texts that are allowed; empty for any text.
    default : str, optional
        Value if the key is missing, which is not checked; None if the key is required.

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
    """Read the value of a key that must be a list of texts; return () if the key is missing.

    Parameters
    ----------
    table : Toml
        Table of the section with the key.
    path : str
        Path of the key.
    legal : sequence of str, optional
        Texts that are allowed; empty for any texts.
    distinct : bool, optional
        If True, no text may occur twice in the list.

    Returns
    -------
    tuple of str
        The texts.

    Raises
    ------
    BadInput
        If the value is not a list of allowed texts, or if `distinct` is True and a text occurs twice.
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
    """Read the value of a key that must be a finite number.

    Parameters
    ----------
    table : Toml
        Table of the section with the key.
    path : str
        Path of the key.
    lo, hi : float
        Smallest and largest number that is allowed.
    default : float, optional
        Value if the key is missing, which is not checked; None if the key is required.

    Returns
    -------
    float
        The number.

    Raises
    ------
    BadInput
        If the key is missing without a default, or the value is not a number.
    OutOfRange
        If the number is outside its limits, NaN or infinite.
    """
    if default is not None and not has_key(table, path):
        return default
    return checked_number(required_value(table, path), path, lo, hi)


def optional_number(table: Toml, path: str, lo: float, hi: float) -> float | None:
    """Read the value of a key that must be a finite number; return None if the key is missing.

    Parameters
    ----------
    table : Toml
        Table of the section with the key.
    path : str
        Path of the key.
    lo, hi : float
        Smallest and largest number that is allowed.

    Returns
    -------
    float or None
        The number, or None.

    Raises
    ------
    BadInput
        If the value is not a number.
    OutOfRange
        If the number is outside its limits, NaN or infinite.
    """
    return number(table, path, lo, hi) if has_key(table, path) else None


def checked_number(value: object, path: str, lo: float, hi: float) -> float:
    """Check that a value is a finite number, and return it as float.

    Parameters
    ----------
    value : object
        Value in the request.
    path : str
        Path of the key, for error messages.
    lo, hi : float
        Smallest and largest number that is allowed.

    Returns
    -------
    float
        The number.

    Raises
    ------
    BadInput
        If the value is not a number; true and false are not numbers.
    OutOfRange
        If the number is outside its limits, NaN or infinite.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise BadInput(f"{path} must be a number, got {quote_value(value)}")
    # Compare before the conversion to float, which fails for huge whole numbers. TOML has no upper limit for them.
    if not lo <= value <= hi or not math.isfinite(value):
        raise OutOfRange(path, quote_value(value), lo, hi)
    return float(value)


def integer(table: Toml, path: str, lo: int, hi: int, default: int | None = None) -> int:
    """Read the value of a key that must be a whole number.

    Parameters
    ----------
    table : Toml
        Table of the section with the key.
    path : str
        Path of the key.
    lo, hi : int
        Smallest and largest number that is allowed.
    default : int, optional
        Value if the key is missing, which is not checked; None if the key is required.

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
    """Read the value of a key that must be true or false.

    Parameters
    ----------
    table : Toml
        Table of the section with the key.
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
    """Read the value of a key that must be one of a few whole numbers.

    Parameters
    ----------
    table : Toml
        Table of the section with the key.
    path : str
        Path of the key.
    legal : sequence of int
        Numbers that are allowed.
    default : int
        Value if the key is missing; it must be one of `legal`.

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
    """Read the value of a key that must be a list of two finite numbers.

    Parameters
    ----------
    table : Toml
        Table of the section with the key.
    path : str
        Path of the key.
    lo, hi : float
        Smallest and largest number that is allowed, for both numbers.

    Returns
    -------
    (float, float)
        The numbers, in the order of the list.

    Raises
    ------
    BadInput
        If the key is missing, or the value is not a list of two numbers.
    OutOfRange
        If a number is outside its limits, NaN or infinite.
    """
    numbers = required_value(table, path)
    if not isinstance(numbers, list) or len(numbers) != 2:
        raise BadInput(f"{path} must be [from, to], got {quote_value(numbers)}")
    first, second = (checked_number(item, path, lo, hi) for item in numbers)
    return first, second


def quote_value(value: object) -> str:
    """Return repr(value) for an error message, cut to at most 60 characters."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
