"""The errors of truesky: every refusal of input is one of these, with one line that names what is wrong and where."""

from __future__ import annotations


class LakeError(Exception):
    """Root of everything that truesky refuses; its text is one line."""


class BadInput(LakeError):
    """A request, a file or a table that cannot be used; the text names the key, file, column or row."""


class OutOfRange(BadInput):
    """A number outside its declared bounds."""

    def __init__(self, name: str, value: object, lo: object, hi: object) -> None:
        super().__init__(f"{name} = {value} is outside [{lo}, {hi}]")


class Damaged(LakeError):
    """A published file that is not what its manifest says; the text names the file."""


class Superseded(LakeError):
    """Another run published or holds the table that this one meant to publish."""


class VersionMismatch(LakeError):
    """A table written with another version of its declaration, and no way to read it safely."""


class PartsFailed(LakeError):
    """Some parts of a table could not be made; the text lists them, the others are staged and kept."""
