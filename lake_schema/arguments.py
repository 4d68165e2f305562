"""Check arguments of public functions; the message of every error contains the name of the argument."""

from __future__ import annotations

import functools
import inspect
import math
import numbers
import operator
import re
from collections.abc import Callable, Iterable
from typing import Any, ParamSpec, TypeVar

from lake_schema.errors import BadInput, OutOfRange, quote_value
from lake_schema.texts import spelling

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")
# Degrees per unit of an angle, by the names of the unit in texts such as "1 arcmin".
_DEGREES = {
    **dict.fromkeys(("deg", "degree", "degrees", "d", "°"), 1.0),
    **dict.fromkeys(("arcmin", "arcminute", "arcminutes", "'", "′"), 1.0 / 60.0),
    **dict.fromkeys(("arcsec", "arcsecond", "arcseconds", '"', "″"), 1.0 / 3600.0),
    **dict.fromkeys(("rad", "radian", "radians"), math.degrees(1.0)),
}
_ANGLE = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([^\d\s]*)\s*")


def refuse_missing(call: str) -> Callable[[Callable[_Parameters, _Result]], Callable[_Parameters, _Result]]:
    """Return a decorator of a function that raises BadInput instead of TypeError for missing and unknown arguments.

    The signature of the function does not change. `call` is an example of a call, for the messages, such as
    "lake.render(ra, dec)"; its text before the bracket is the name of the function. If one of the arguments is a
    SkyCoord, the message says how to give it as numbers.
    """

    def decorate(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
        signature = inspect.signature(function)
        takes_any = inspect.Parameter.VAR_KEYWORD in [parameter.kind for parameter in signature.parameters.values()]
        required = [name for name, parameter in signature.parameters.items() if _is_required(parameter)]
        unnamed = [name for name in required if signature.parameters[name].kind is inspect.Parameter.POSITIONAL_ONLY]

        @functools.wraps(function)
        def call_function(*args: _Parameters.args, **kwargs: _Parameters.kwargs) -> _Result:
            given: dict[str, object] = dict(zip(signature.parameters, args, strict=False))
            # The name of an argument that is given without its name may also be that of a parameter of an SQL query.
            given |= {str(name): value for name, value in kwargs.items() if name not in unnamed}
            for name in [] if takes_any else [name for name in given if name not in signature.parameters]:
                hint = spelling.choices(name, [other for other in signature.parameters if other != "self"])
                raise BadInput(f"{call.partition('(')[0]} has no argument {name}: {hint}")
            if missing := [name for name in required if name not in given]:
                for name, value in given.items():
                    refuse_coordinates(name, value)
                raise BadInput(f"{' and '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing: write {call}")
            return function(*args, **kwargs)

        return call_function

    return decorate


def _is_required(parameter: inspect.Parameter) -> bool:
    is_single = parameter.kind not in (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return is_single and parameter.default is inspect.Parameter.empty


def refuse_coordinates(name: str, value: object) -> None:
    """Raise BadInput if an argument, which must be a number in degrees, is a SkyCoord of astropy.

    `name` is the name of the argument, for the message.
    """
    # Only coordinates of astropy have this attribute. astropy is not imported here, because the import is slow.
    if not isinstance(value, type) and hasattr(value, "icrs"):
        frame = getattr(getattr(value, "frame", value), "name", "")
        c = "c" if frame == "icrs" else "c.icrs"
        kind = type(value).__name__
        raise BadInput(f"{name} must be a number in degrees, got a {kind}: write {c}.ra.deg, {c}.dec.deg")


def exchanged_question(ra: object, dec: object) -> str:
    """Return "are ra and dec exchanged?" if a declination is out of range and its right ascension is not, else "".

    `ra` and `dec` are in degrees; the result is "" if one of them is not a number.
    """
    # Values are not converted to float, which fails for huge whole numbers.
    values: list[Any] = [
        abs(value) for value in (ra, dec) if isinstance(value, numbers.Real) and not isinstance(value, bool)
    ]
    is_exchanged = len(values) == 2 and values[0] <= 90.0 < values[1] <= 360.0
    return "are ra and dec exchanged?" if is_exchanged else ""


def check_degrees(name: str, value: object, lo: float = -math.inf, hi: float = math.inf) -> float:
    """Return an angle in degrees as a float if it is a number within its bounds, which are included.

    Parameters
    ----------
    name : str
        Name of the argument, for the message.
    value : object
        Value that the user gave.
    lo, hi : float, optional
        Smallest and largest angle that is allowed. By default all numbers are allowed.

    Returns
    -------
    float
        The angle.

    Raises
    ------
    BadInput
        If the value is not a number. For a text such as "1 arcmin", a Quantity and a SkyCoord, the message contains the
        number to write.
    OutOfRange
        If the value is NaN or lies outside its bounds.
    """
    refuse_coordinates(name, value)
    refuse_angle(name, value, f"of degrees from {lo:g} to {hi:g}" if lo > -math.inf else "in degrees")
    return check_number(name, value, lo, hi, "deg")


def refuse_angle(name: str, value: object, form: str, unit: str = "deg", digits: int = 6) -> None:
    """Refuse an argument that is a text such as "1 arcmin" or a Quantity of astropy that is an angle.

    Parameters
    ----------
    name : str
        Name of the argument, for the message.
    value : object
        Value that the user gave. Other values are accepted.
    form : str
        Unit and range of the numbers that are allowed, such as "in degrees".
    unit : str, optional
        Unit of the number that the message contains: "deg" or "arcsec".
    digits : int, optional
        Number of decimals of this number.

    Raises
    ------
    BadInput
        If the value is such an angle. The message contains the number to write.
    """
    if isinstance(value, str):
        match = _ANGLE.fullmatch(value)
        if match and not match[2]:
            # A number in quotes has the unit of the argument.
            raise BadInput(f"{name} must be a number {form}, got {value!r} in quotes: write {match[1]}")
        scale = _DEGREES.get(match[2].lower()) if match else None
        degrees = float(match[1]) * scale if match and scale else None
        text = repr(value)
    else:
        try:
            degrees = float(value.to_value("deg"))  # type: ignore[attr-defined]
        except (AttributeError, TypeError, ValueError):
            degrees = None
        text = quote_value(value, str)
    if degrees is not None:
        angle = degrees / _DEGREES["arcsec"] if unit == "arcsec" else degrees
        number = f"{round(angle, digits):.12g}" if abs(angle) >= 1e-3 else f"{angle:.6g}"
        raise BadInput(f"{name} must be a number {form}, got {text}: write {number}")


def check_number(name: str, value: object, lo: float = -math.inf, hi: float = math.inf, unit: str = "") -> float:
    """Return a number as a float if it lies within its bounds, which are included.

    Parameters
    ----------
    name : str
        Name of the argument, for the message.
    value : object
        Value that the user gave.
    lo, hi : float, optional
        Smallest and largest number that is allowed. By default all numbers are allowed, including infinities.
    unit : str, optional
        Unit of the number, for the message.

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
        # Compare before converting: the comparison raises TypeError for a str, which float() might accept, and float()
        # fails for huge whole numbers.
        is_within = bool(lo <= value <= hi)  # type: ignore[operator]
        converted = float(value) if is_within else math.nan  # type: ignore[arg-type]
    except OverflowError:
        is_within = False
    except (TypeError, ValueError):
        raise BadInput(f"{name} = {quote_value(value)} is not a number") from None
    if not is_within:
        raise OutOfRange(name, value, lo, hi, unit)
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
        If `value` is a text or not iterable, or if an element is not an integer.
    OutOfRange
        If an element lies outside the bounds.
    """
    if isinstance(value, str) or not isinstance(value, Iterable):
        is_number = isinstance(value, numbers.Integral) and not isinstance(value, bool)
        remedy = f": write {name}=[{value}]" if is_number else ""
        raise BadInput(f"{name} = {value!r} is not a list of whole numbers{remedy}")
    return [check_integer(name, item, lo, hi) for item in value]


def check_names(name: str, value: str | Iterable[str]) -> tuple[str, ...]:
    """Return a str as a tuple of length 1, and a list or another iterable of str as a tuple.

    `name` is the name of the argument, for the message.

    Raises
    ------
    BadInput
        If `value` is neither a str nor an iterable of str.
    """
    if isinstance(value, str):
        return (value,)
    items = tuple(value) if isinstance(value, Iterable) else (value,)
    if not all(isinstance(item, str) for item in items):
        raise BadInput(f"{name} = {value!r} is not a name or a list of names")
    return items
