"""Exceptions of truesky. The text of each is one line that names the problem and its place."""

from __future__ import annotations

# Maximum length of a message in characters: it names the problem and its place, and does not repeat all input.
_MAX_LENGTH = 1000


def one_line(message: object) -> str:
    """Return a text as one line of printable characters; a long text is shortened in the middle."""
    text = str(message)
    if not text.isprintable():
        text = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in " ".join(text.split()))
    half = _MAX_LENGTH // 2
    return text if len(text) <= _MAX_LENGTH else f"{text[: half - 3]}...{text[-half:]}"


class LakeError(Exception):
    """Base class of all errors that truesky raises; its text is one line of at most 1000 characters."""

    def __init__(self, message: object = "") -> None:
        super().__init__(one_line(message))


class BadInput(LakeError):
    """A request, file or table cannot be used; the text names the key, file, column or row."""


class OutOfRange(BadInput):
    """A number is outside its allowed range.

    Parameters
    ----------
    name : str
        Name of the quantity.
    value : object
        Its value.
    lo, hi : object
        Smallest and largest value that is allowed.
    """

    def __init__(self, name: str, value: object, lo: object, hi: object) -> None:
        super().__init__(f"{name} = {value} is outside [{lo}, {hi}]")
        self._arguments = name, value, lo, hi

    def __reduce__(self) -> tuple[type[OutOfRange], tuple[object, ...]]:
        # Pickling an exception needs the arguments of its constructor, not its text.
        return OutOfRange, self._arguments


class Damaged(LakeError):
    """A published file differs from its manifest; the text names the file."""


class Superseded(LakeError):
    """Another run has published or locked the table that this run was going to publish."""


class VersionMismatch(LakeError):
    """A table was written with another version of its declaration and cannot be read safely."""


class TasksFailed(LakeError):
    """Some tasks of a table failed; the text lists them. The output of the other tasks is staged and kept."""
