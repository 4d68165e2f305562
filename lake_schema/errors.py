"""Exceptions of truesky. The message of each is one line that names the problem, and the file, key, column or row."""

from __future__ import annotations

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


class LakeError(Exception):
    """Base class of the exceptions of truesky; the message is turned into one line of at most 1000 characters."""

    def __init__(self, message: object = "") -> None:
        super().__init__(one_line(message))


class BadInput(LakeError):
    """An argument, a settings file or another input of the user cannot be used, for example because a key is missing.

    The message names the argument, key, file, column or row.
    """


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
    """

    def __init__(self, name: str, value: object, lo: object, hi: object) -> None:
        super().__init__(f"{name} = {value} is outside [{lo}, {hi}]")
        self._arguments = name, value, lo, hi

    def __reduce__(self) -> tuple[type[OutOfRange], tuple[object, ...]]:
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
