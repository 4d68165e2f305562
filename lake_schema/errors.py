"""The errors of truesky: every refusal of input is one of these, with one line that names what is wrong and where."""

from __future__ import annotations

# Characters of a refusal: it names what is wrong and where, it does not repeat what it was given.
_MAX_LENGTH = 1000


def one_line(message: object) -> str:
    """A text as messages give it: one line of printable characters, of a long one its begin and its end."""
    text = str(message)
    if not text.isprintable():
        text = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in " ".join(text.split()))
    half = _MAX_LENGTH // 2
    return text if len(text) <= _MAX_LENGTH else f"{text[: half - 3]}...{text[-half:]}"


class LakeError(Exception):
    """Root of everything that truesky refuses; its text is one line of at most 1000 characters, whatever it names."""

    def __init__(self, message: object = "") -> None:
        super().__init__(one_line(message))


class BadInput(LakeError):
    """A request, a file or a table that cannot be used; the text names the key, file, column or row."""


class OutOfRange(BadInput):
    """A number outside its declared bounds."""

    def __init__(self, name: str, value: object, lo: object, hi: object) -> None:
        super().__init__(f"{name} = {value} is outside [{lo}, {hi}]")
        self._arguments = name, value, lo, hi

    def __reduce__(self) -> tuple[type[OutOfRange], tuple[object, ...]]:
        # An exception comes back from another process by the arguments that it was made with.
        return OutOfRange, self._arguments


class Damaged(LakeError):
    """A published file that is not what its manifest says; the text names the file."""


class Superseded(LakeError):
    """Another run published or holds the table that this one meant to publish."""


class VersionMismatch(LakeError):
    """A table written with another version of its declaration, and no way to read it safely."""


class TasksFailed(LakeError):
    """Some parts of a table could not be made; the text lists them, the others are staged and kept."""
