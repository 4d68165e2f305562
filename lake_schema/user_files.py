"""Files and folders that a user names: the one place that opens them, and the one reader of TOML.

checked     a file of a kind, ready for a library that opens it by itself
opened      the same, as a stream of bytes
text        its text
toml        its tables
target      where a result may be written;  folder : where several may
staged      a file that takes its place in one rename
expanded    a path as it was typed
reachable   refuses a path that the system does not take
shown       a path as messages name it

Only a regular file is opened: a pipe would never answer, a device never end. Every kind has a largest size.
Every refusal is a BadInput of one line that names the file.
"""

from __future__ import annotations

import os
import re
import stat
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from lake_schema.errors import BadInput

_MB, _GB = 1 << 20, 1 << 30
# Largest file of each kind, bytes. Catalogues are read in pieces; of the others all that is of use is held.
MAX_BYTES = {
    "request": _MB,
    "table of pointings": 64 * _MB,
    "curve": 16 * _MB,
    "table of a curve": 4 * _MB,
    "library of spectra": 64 * _MB,
    "PSF": 512 * _MB,
    "map of dust": 8 * _GB,
    "library of galaxies": 128 * _MB,
    "catalogue of stars": 2 * _GB,
    "table of bodies": 4 * _GB,
    "table of sources": 64 * _MB,
    "table of a camera": 4 * _MB,
    "catalogue": 1 << 42,
    "run log": _GB,
    "master frame": _GB,
    "calibrated image": 16 * _GB,
    "manifest": 4 * _GB,
}
_MAX_SHOWN_LENGTH, _MAX_PATH_LENGTH = 200, 4096
# Parts of a dotted key, depth of brackets, characters of a number or bare key: far more than anything of ours has.
_MAX_KEY_PARTS, _MAX_DEPTH, _MAX_WORD_LENGTH = 16, 16, 200
# Strings and comments are passed over whole, as tomllib does; whatever is wrong with them it says itself.
_TOKEN = re.compile(
    r'"""(?:[^"\\]++|\\.|"(?!"")|""(?!"))*+"{3,5}'
    r"|'''(?:[^']++|'(?!'')|''(?!'))*+'{3,5}"
    r'|"(?:[^"\\\n]++|\\.)*+"'
    r"|'[^'\n]*+'"
    r"|#[^\n]*+|[A-Za-z0-9_+-]++|[ \t\r]++|.",
    re.DOTALL,
)


def expand_path(text: str | Path, folder: Path | None = None) -> Path:
    """A path as it was typed, ~ replaced, found from a folder."""
    if not isinstance(text, str | Path):
        raise BadInput(f"{format_path(repr(text))} is not a path")
    if len(str(text)) > _MAX_PATH_LENGTH:
        # Following its links, were there any, takes a square of the time.
        raise BadInput(f"{format_path(text)}: File name too long")
    try:
        path = Path(text).expanduser()
    except RuntimeError:
        raise BadInput(f"{format_path(text)}: there is no such user") from None
    except ValueError as error:
        raise BadInput(f"{format_path(text)}: {error}") from None
    return path if folder is None else folder / path


def format_path(path: str | Path) -> str:
    """A path as messages name it: one line, never long."""
    name = str(path)
    printable = name if name.isprintable() else ascii(name)[1:-1]
    return printable if len(printable) <= _MAX_SHOWN_LENGTH else f"{printable[:80]}...{printable[-80:]}"


def check_file(path: Path, kind: str, key: str = "") -> Path:
    """The path of a regular file that can be read and is not larger than its kind may be.

    key : of the request, to be named in the message
    """
    try:
        os.close(_open_descriptor(path, kind))
    except BadInput as error:
        raise BadInput(f"{key}: {error}" if key else str(error)) from None
    return path


@contextmanager
def open_file(path: Path, kind: str) -> Iterator[IO[bytes]]:
    """Such a file as a stream of bytes."""
    with os.fdopen(_open_descriptor(path, kind), "rb") as stream:
        yield stream


def _open_descriptor(path: Path, kind: str) -> int:
    try:
        # Looked at before it is opened, which some devices act upon; and again, for it may be another by then.
        _check_regular_file(path, kind, os.stat(path))
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except (FileNotFoundError, NotADirectoryError):
        raise BadInput(f"{format_path(path)}: no such file") from None
    except OSError as error:
        raise BadInput(f"{format_path(path)}: {error.strerror}") from None
    except ValueError as error:
        # A NUL, or a character that the file system cannot hold.
        raise BadInput(f"{format_path(path)}: {error}") from None
    try:
        _check_regular_file(path, kind, os.fstat(descriptor))
    except BadInput:
        os.close(descriptor)
        raise
    return descriptor


def _check_regular_file(path: Path, kind: str, status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode):
        file_type = next((word for word, test in _FILE_TYPES if test(status.st_mode)), "no regular file")
        raise BadInput(f"{format_path(path)}: is {file_type}, wanted a file: a {kind}")
    if status.st_size > MAX_BYTES[kind]:
        raise BadInput(f"{format_path(path)}: is larger than {MAX_BYTES[kind]} bytes, the most of a {kind}")


_FILE_TYPES = (
    ("a folder", stat.S_ISDIR),
    ("a pipe", stat.S_ISFIFO),
    ("a device", stat.S_ISCHR),
    ("a device", stat.S_ISBLK),
    ("a socket", stat.S_ISSOCK),
)


def read_text(path: Path, kind: str) -> str:
    """The text of a file, UTF-8, without the byte order mark that Excel and Notepad write."""
    with open_file(path, kind) as stream:
        # No more than was there when it was looked at: a file can grow.
        data = stream.read(MAX_BYTES[kind] + 1)
    if len(data) > MAX_BYTES[kind]:
        raise BadInput(f"{format_path(path)}: is larger than {MAX_BYTES[kind]} bytes, the most of a {kind}")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadInput(f"{format_path(path)}: {error}") from None


@contextmanager
def check_reachable(path: Path) -> Iterator[None]:
    """Refuse a path that the system does not take; a path that is not there yet is accepted."""
    try:
        yield
        os.lstat(path)
    except FileNotFoundError:
        pass
    except (OSError, RuntimeError, ValueError) as error:
        # Python below 3.13 reports a loop of links as a RuntimeError.
        raise BadInput(f"{format_path(path)}: {getattr(error, 'strerror', None) or error}") from None


def check_target(path: Path, endings: Sequence[str] = ()) -> Path:
    """A path at which a file can be written: of one of the endings, in a folder that is there."""
    if endings and path.suffix.lower() not in endings:
        raise BadInput(f"{format_path(path)}: the ending is not one of {', '.join(endings)}")
    with check_reachable(path):
        if not path.parent.is_dir():
            raise BadInput(f"{format_path(path)}: its folder is not there")
        if os.path.lexists(path) and not path.is_file():
            raise BadInput(f"{format_path(path)}: is there, and is no file")
        _refuse_unwritable(path, path.parent)
    return path


def check_folder(path: Path) -> Path:
    """A path at which a folder is, or can be made."""
    with check_reachable(path):
        if os.path.lexists(path) and not path.is_dir():
            raise BadInput(f"{format_path(path)}: is there, and is no folder")
        nearest = next(candidate for candidate in (path, *path.absolute().parents) if os.path.lexists(candidate))
        if not nearest.is_dir():
            raise BadInput(f"{format_path(path)}: {format_path(nearest)} is no folder")
        _refuse_unwritable(path, nearest)
    return path


def _refuse_unwritable(path: Path, folder: Path) -> None:
    if not os.access(folder, os.W_OK | os.X_OK):
        raise BadInput(f"{format_path(path)}: its folder cannot be written to")


@contextmanager
def replace_atomically(path: Path) -> Iterator[Path]:
    """A temporary name beside a file: what is written to it replaces the file in one rename, or is removed."""
    temporary = path.with_name(f".{os.getpid()}.tmp.{path.name}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


# ------------------------------------------------------------------------------------------------ TOML


def read_toml(path: Path, kind: str) -> dict[str, Any]:
    """The tables of a TOML file."""
    try:
        return parse_toml(read_text(path, kind).replace("\r\n", "\n"))
    except ValueError as error:
        # Of tomllib, and of a date that no calendar has.
        raise BadInput(f"{format_path(path)}: {' '.join(str(error).split())}") from None


def parse_toml(source: str) -> dict[str, Any]:
    """The tables of a TOML text.

    Errors : ValueError where it is none, or has what the parser needs a square of the time for, or no end of depth
    """
    _refuse_deep(source)
    return tomllib.loads(source)


def _refuse_deep(source: str) -> None:
    depth, dots, line = 0, 0, 1
    for match in _TOKEN.finditer(source):
        token = match[0]
        first = token[0]
        if first == ".":
            dots += 1
            if dots >= _MAX_KEY_PARTS:
                raise ValueError(f"a key or number of more than {_MAX_KEY_PARTS} parts (at line {line})")
        elif first in "[{":
            depth, dots = depth + 1, 0
            if depth > _MAX_DEPTH:
                raise ValueError(f"more than {_MAX_DEPTH} brackets within one another (at line {line})")
        elif first in "]}":
            depth, dots = depth - 1, 0
        elif first in ",=\n#":
            dots = 0
        elif len(token) > _MAX_WORD_LENGTH and first not in "\"' \t\r":
            raise ValueError(f"a number or key of more than {_MAX_WORD_LENGTH} characters (at line {line})")
        line += token.count("\n")
