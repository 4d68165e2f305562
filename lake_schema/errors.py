"""The errors of truesky: every refusal of input is one of these, with one line that names what is wrong and where."""

from __future__ import annotations

# Characters of a refusal: it names what is wrong and where, it does not repeat what it was given.
_LONGEST = 1000


def one_line(said: object) -> str:
    """A text as messages give it: one line of printable characters, of a long one its begin and its end."""
    text = str(said)
    if not text.isprintable():
        text = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in " ".join(text.split()))
    half = _LONGEST // 2
    return text if len(text) <= _LONGEST else f"{text[: half - 3]}...{text[-half:]}"


class LakeError(Exception):
    """Root of everything that truesky refuses; its text is one line of at most 1000 characters, whatever it names."""

    def __init__(self, said: object = "") -> None:
        super().__init__(one_line(said))


class BadInput(LakeError):
    """A request, a file or a table that cannot be used; the text names the key, file, column or row."""


class OutOfRange(BadInput):
    """A number outside its declared bounds."""

    def __init__(self, name: str, value: object, lo: object, hi: object) -> None:
        super().__init__(f"{name} = {value} is outside [{lo}, {hi}]")
        self._given = name, value, lo, hi

    def __reduce__(self) -> tuple[type[OutOfRange], tuple[object, ...]]:
        # An exception comes back from another process by the arguments that it was made with.
        return OutOfRange, self._given


class Damaged(LakeError):
    """A published file that is not what its manifest says; the text names the file."""


class Superseded(LakeError):
    """Another run published or holds the table that this one meant to publish."""


class VersionMismatch(LakeError):
    """A table written with another version of its declaration, and no way to read it safely."""


class PartsFailed(LakeError):
    """Some parts of a table could not be made; the text lists them, the others are staged and kept."""
