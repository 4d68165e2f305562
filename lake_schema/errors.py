"""Exceptions of truesky. The message of each is one line that names the problem, and the file, key, column or row."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from types import TracebackType
from typing import ParamSpec, TypeVar, cast

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")

# Maximum length of a message in characters. A message may quote input, which can be very long.
_MAX_LENGTH = 1000


def one_line(message: object) -> str:
    """Return a text as one line of printable characters; a text above 1000 characters is shortened in the middle.

    Line ends become spaces, and other characters that cannot be printed become escape sequences such as \\x1b.
    """
    text = str(message)
    if not text.isprintable():
        text = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in " ".join(text.split()))
    half = _MAX_LENGTH // 2
    return text if len(text) <= _MAX_LENGTH else f"{text[: half - 3]}...{text[-half:]}"


def quote_value(value: object, to_text: Callable[[object], str] = repr) -> str:
    """Return repr(value), or the result of another function, for an error message, cut to at most 60 characters."""
    try:
        text = to_text(value)
    except ValueError:
        # Python does not print whole numbers of more than 4300 digits.
        text = "a whole number of thousands of digits"
    return text if len(text) <= 60 else text[:57] + "..."


class LakeError(Exception):
    """Base class of the exceptions of truesky; the message is turned into one line of at most 1000 characters."""

    def __init__(self, message: object = "") -> None:
        super().__init__(one_line(message))


class BadInput(LakeError):
    """An argument, a settings file or another input of the user cannot be used, for example because a key is missing.

    The message names the argument, key, file, column or row.
    """

    @property
    def messages(self) -> tuple[str, ...]:
        """Return one line for each mistake."""
        return (str(self),)

    def with_prefix(self, place: str) -> BadInput:
        """Return an error whose lines begin with `place` and a colon, followed by the lines of this error."""
        return bad_input(f"{place}: {message}" for message in self.messages)


class BadInputs(BadInput):
    """Several mistakes of a user's input, which were found together.

    Parameters
    ----------
    messages : iterable of str
        One line per mistake.
    """

    def __init__(self, messages: Iterable[str]) -> None:
        self._messages = tuple(one_line(message) for message in messages)
        super().__init__("; ".join(self._messages))

    @property
    def messages(self) -> tuple[str, ...]:
        """Return one line for each mistake."""
        return self._messages

    def __reduce__(self) -> tuple[type[BadInputs], tuple[object, ...]]:
        # By default, unpickling an exception calls the constructor with the joined message as its only argument.
        return BadInputs, (self._messages,)


class PartOfLake(BadInput):
    """A folder inside a lake was given as the lake.

    Parameters
    ----------
    message : object
        The message, which names the folder and the lake.
    request : str, optional
        Name of the request to which the folder belongs, "" for none.
    """

    def __init__(self, message: object, request: str = "") -> None:
        super().__init__(message)
        self.request = request

    def with_option(self, option: str) -> BadInput:
        """Return an error that also tells the option for the request, such as "--name {}", if the folder has one."""
        return BadInput(f"{self} and {option.format(self.request)}") if self.request else self


def bad_input(messages: Iterable[str]) -> BadInput:
    """Return an error for one mistake or for several. Equal messages are one mistake."""
    distinct = tuple(dict.fromkeys(messages))
    return BadInput(distinct[0]) if len(distinct) == 1 else BadInputs(distinct)


class Mistakes:
    """Collect the mistakes of an input in a `with` block, and raise all of them together at its end.

    Values are read with the method `read`, which does not raise BadInput. A value with a mistake is replaced by None.
    The block may store the values in records and test whether they are None, but must not use them otherwise.
    """

    def __init__(self) -> None:
        self._errors: list[BadInput] = []

    def __enter__(self) -> Mistakes:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, BadInput) and self._errors:
            self.add(error)
            raise bad_input(self.messages) from None
        # Another exception, which is not a mistake of the input, is more important.
        if error is None:
            self.raise_all()

    def __len__(self) -> int:
        return len(self.messages)

    @property
    def messages(self) -> tuple[str, ...]:
        """Return the lines of the collected mistakes, each once."""
        return tuple(dict.fromkeys(message for error in self._errors for message in error.messages))

    def add(self, error: BadInput) -> None:
        """Add the mistakes of an error."""
        self._errors.append(error)

    def read(
        self, reader: Callable[_Parameters, _Result], *arguments: _Parameters.args, **options: _Parameters.kwargs
    ) -> _Result:
        """Call a function and return its result. If it raises BadInput, add its mistakes and return None instead.

        Parameters
        ----------
        reader : callable
            Function that reads or checks a value.
        *arguments, **options : object
            Arguments of the function.

        Returns
        -------
        object
            Result of the function, or None after a mistake.
        """
        try:
            return reader(*arguments, **options)
        except BadInput as error:
            self.add(error)
            # The declared type is not the type of None, which is not used: the block ends with an error.
            return cast(_Result, None)

    def raise_all(self) -> None:
        """Raise the only mistake, or all of them as one BadInputs; do nothing without mistakes."""
        if len(self._errors) == 1:
            raise self._errors[0]
        if self._errors:
            raise bad_input(self.messages)


def refuse_mistakes(messages: Iterable[str]) -> None:
    """Raise an error with a line for each mistake; do nothing without mistakes. Equal messages are one mistake."""
    listed = list(messages)
    if listed:
        raise bad_input(listed)


class OutOfRange(BadInput):
    """A number is outside its allowed range, or it is NaN.

    Parameters
    ----------
    name : str
        Name of the quantity.
    value : object
        The number that was refused.
    lo, hi : object
        Smallest and largest value that is allowed.
    unit : str, optional
        Unit of the limits.
    question : str, optional
        Question about the cause, such as "are ra and dec exchanged?".
    """

    def __init__(self, name: str, value: object, lo: object, hi: object, unit: str = "", question: str = "") -> None:
        limits = f"{name} = {quote_value(value, str)} is outside [{lo}, {hi}] {unit}".rstrip()
        if (lo, hi) == (-math.inf, math.inf):
            limits = f"{name} = {quote_value(value, str)} is not a finite number"
        super().__init__(f"{limits}: {question}" if question else limits)
        self._arguments = name, value, lo, hi, unit, question

    def with_question(self, question: str) -> OutOfRange:
        """Return the error with a question about the cause at its end."""
        return OutOfRange(*self._arguments[:5], question)

    def __reduce__(self) -> tuple[type[OutOfRange], tuple[object, object, object, object, str, str]]:
        # By default, unpickling an exception calls the constructor with the message as its only argument.
        return OutOfRange, self._arguments


class Damaged(LakeError):
    """A file of a published table is missing or differs from its recorded checksum; the message names the file."""


class Superseded(LakeError):
    """Another process has published a table, or holds its lock, so that this process cannot publish the table."""


class VersionMismatch(LakeError):
    """A table was written by another version of truesky with other columns or units, so it cannot be read safely."""


class TasksFailed(LakeError):
    """Some partitions (files) of a table could not be made; the message lists them.

    The finished partitions are kept, so the next run makes only the missing ones.
    """
