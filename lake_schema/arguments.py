"""Check arguments of public functions; the message of every error contains the name of the argument."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable, Sequence

from lake_schema.errors import BadInput, OutOfRange


def check_number(name: str, value: object, lo: float = -math.inf, hi: float = math.inf) -> float:
    """Return a number as a float if it lies within its bounds, which are included.

    Parameters
    ----------
    name : str
        Name of the argument, for the message.
    value : object
        Value that the user gave.
    lo, hi : float, optional
        Smallest and largest number that is allowed. By default all numbers are allowed, including infinities.

    Returns
    -------
    float
        The number.

    Raises
    ------
    BadInput
        If the value is not a number; a str such as "1" is not accepted.
    OutOfRange
        If the value is NaN or lies outside its bounds.
    """
    try:
        # Compare before converting: the comparison raises TypeError for a str, which float() might accept.
        is_within, converted = bool(lo <= value <= hi), float(value)  # type: ignore[operator, arg-type]
    except (TypeError, ValueError, OverflowError):
        raise BadInput(f"{name} = {value!r} is not a number") from None
    if not is_within:
        raise OutOfRange(name, value, lo, hi)
    return converted


def check_integer(name: str, value: object, lo: int, hi: int) -> int:
    """Return a whole number as an int if it lies within its bounds, which are included.

    Parameters
    ----------
    name : str
        Name of the argument, for the message.
    value : object
        Value that the user gave, such as an int or a NumPy integer.
    lo, hi : int
        Smallest and largest number that is allowed.

    Returns
    -------
    int
        The number.

    Raises
    ------
    BadInput
        If the value is not an integer; a float such as 2.0 is not accepted.
    OutOfRange
        If the value lies outside its bounds.
    """
    try:
        converted = operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        raise BadInput(f"{name} = {value!r} is not a whole number") from None
    if not lo <= converted <= hi:
        raise OutOfRange(name, converted, lo, hi)
    return converted


def check_integers(name: str, value: Iterable[object], lo: int, hi: int) -> list[int]:
    """Return whole numbers as a list of int if all of them lie within the bounds, which are included.

    Parameters
    ----------
    name : str
        Name of the argument, for the message.
    value : iterable
        Values that the user gave; it may be empty.
    lo, hi : int
        Smallest and largest number that is allowed.

    Returns
    -------
    list of int
        The numbers, in the same order.

    Raises
    ------
    BadInput
        If `value` is not iterable, or if an element is not an integer.
    OutOfRange
        If an element lies outside the bounds.
    """
    if not isinstance(value, Iterable):
        raise BadInput(f"{name} = {value!r} is not a list of whole numbers")
    return [check_integer(name, item, lo, hi) for item in value]


def check_names(name: str, value: str | Sequence[str]) -> tuple[str, ...]:
    """Return a str as a tuple of length 1, and a sequence of str as a tuple.

    `name` is the name of the argument, for the message.

    Raises
    ------
    BadInput
        If `value` is neither a str nor a sequence of str.
    """
    if isinstance(value, str):
        return (value,)
    items = tuple(value) if isinstance(value, Iterable) else (value,)
    if not all(isinstance(item, str) for item in items):
        raise BadInput(f"{name} = {value!r} is not a name or a list of names")
    return items
