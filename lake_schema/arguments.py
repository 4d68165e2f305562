"""Arguments of functions that users call, each refused by its name.

number     a number within its bounds
whole      a whole number within its bounds;  wholes : several
names      one name or several
"""

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
        What the user gave.
    lo, hi : float, optional
        Smallest and largest number that is allowed.

    Returns
    -------
    float
        The number.

    Raises
    ------
    BadInput
        If it is not a number, is NaN or lies outside its bounds.
    """
    try:
        # A text is no number, even if it could be read as one.
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
        What the user gave, such as an int or an integer of numpy.
    lo, hi : int
        Smallest and largest number that is allowed.

    Returns
    -------
    int
        The number.

    Raises
    ------
    BadInput
        If it is not a whole number or lies outside its bounds.
    """
    try:
        converted = operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        raise BadInput(f"{name} = {value!r} is not a whole number") from None
    if not lo <= converted <= hi:
        raise OutOfRange(name, converted, lo, hi)
    return converted


def check_integers(name: str, value: Iterable[object], lo: int, hi: int) -> list[int]:
    """Return whole numbers as a list of int.

    name, lo, hi : as for `whole`;  value : the numbers

    Raises
    ------
    BadInput
        If it is not a sequence, or an element is refused by `whole`.
    """
    if not isinstance(value, Iterable):
        raise BadInput(f"{name} = {value!r} is not a list of whole numbers")
    return [check_integer(name, item, lo, hi) for item in value]


def check_names(name: str, value: str | Sequence[str]) -> tuple[str, ...]:
    """Return one name or several as a tuple.

    Raises
    ------
    BadInput
        If it is neither a text nor a sequence of texts.
    """
    if isinstance(value, str):
        return (value,)
    items = tuple(value) if isinstance(value, Iterable) else (value,)
    if not all(isinstance(item, str) for item in items):
        raise BadInput(f"{name} = {value!r} is not a name or a list of names")
    return items
