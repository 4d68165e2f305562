"""Check arguments of functions that users call; an error message names the argument."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable, Sequence

from lake_schema.errors import BadInput, OutOfRange


def check_number(name: str, value: object, lo: float = -math.inf, hi: float = math.inf) -> float:
    """Return a number as a float if it lies within its bounds.

    Parameters
    ----------
    name : str
        Name of the argument, for the message.
    value : object
        Value that the user gave.
    lo, hi : float, optional
        Smallest and largest number that is allowed.

    Returns
    -------
    float
        The number.

    Raises
    ------
    BadInput
        If it is not a number.
    OutOfRange
        If it is NaN or lies outside its bounds.
    """
    try:
        # The comparison refuses a text, even if float() could read it.
        is_within, converted = bool(lo <= value <= hi), float(value)  # type: ignore[operator, arg-type]
    except (TypeError, ValueError, OverflowError):
        raise BadInput(f"{name} = {value!r} is not a number") from None
    if not is_within:
        raise OutOfRange(name, value, lo, hi)
    return converted


def check_integer(name: str, value: object, lo: int, hi: int) -> int:
    """Return a whole number as an int if it lies within its bounds.

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
        If it is not a whole number.
    OutOfRange
        If it lies outside its bounds.
    """
    try:
        converted = operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        raise BadInput(f"{name} = {value!r} is not a whole number") from None
    if not lo <= converted <= hi:
        raise OutOfRange(name, converted, lo, hi)
    return converted


def check_integers(name: str, value: Iterable[object], lo: int, hi: int) -> list[int]:
    """Return whole numbers as a list of int if they lie within their bounds.

    Parameters
    ----------
    name : str
        Name of the argument, for the message.
    value : iterable
        Values that the user gave.
    lo, hi : int
        Smallest and largest number that is allowed.

    Returns
    -------
    list of int
        The numbers.

    Raises
    ------
    BadInput
        If `value` is not a list, or if `check_integer` refuses an element.
    """
    if not isinstance(value, Iterable):
        raise BadInput(f"{name} = {value!r} is not a list of whole numbers")
    return [check_integer(name, item, lo, hi) for item in value]


def check_names(name: str, value: str | Sequence[str]) -> tuple[str, ...]:
    """Return one name or several as a tuple.

    Raises
    ------
    BadInput
        If the value is neither a text nor a sequence of texts.
    """
    if isinstance(value, str):
        return (value,)
    items = tuple(value) if isinstance(value, Iterable) else (value,)
    if not all(isinstance(item, str) for item in items):
        raise BadInput(f"{name} = {value!r} is not a name or a list of names")
    return items
