"""Open, check and write files that a user names, and parse TOML.

Only regular files are opened: a pipe might never answer, and a device might never end. Each kind of file has a largest
size. All errors are BadInput with one line that names the file.
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
# Largest size of each kind of file in bytes. Catalogues are read in pieces, all other files into memory.
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
# Limits of a TOML text: parts of a dotted key, nested brackets, characters of a number or bare key. Requests stay far
# below them.
_MAX_KEY_PARTS, _MAX_DEPTH, _MAX_WORD_LENGTH = 16, 16, 200
# Strings and comments are skipped as a whole; tomllib reports their errors.
_TOKEN = re.compile(
    r'"""(?:[^"\\]++|\\.|"(?!"")|""(?!"))*+"{3,5}'
    r"|'''(?:[^']++|'(?!'')|''(?!'))*+'{3,5}"
    r'|"(?:[^"\\\n]++|\\.)*+"'
    r"|'[^'\n]*+'"
    r"|#[^\n]*+|[A-Za-z0-9_+-]++|[ \t\r]++|.",
    re.DOTALL,
)


def expand_path(text: str | Path, folder: Path | None = None) -> Path:
    """Return the path for a text that a user typed: ~ is expanded, and a relative path starts at `folder` if given."""
    if not isinstance(text, str | Path):
        raise BadInput(f"{format_path(repr(text))} is not a path")
    if len(str(text)) > _MAX_PATH_LENGTH:
        # Resolving the links of a path takes time proportional to the square of its length.
        raise BadInput(f"{format_path(text)}: File name too long")
    try:
        path = Path(text).expanduser()
    except RuntimeError:
        raise BadInput(f"{format_path(text)}: no such user") from None
    except ValueError as error:
        raise BadInput(f"{format_path(text)}: {error}") from None
    return path if folder is None else folder / path


def format_path(path: str | Path) -> str:
    """Return a path as messages show it: one line of printable characters, shortened in the middle if it is long."""
    name = str(path)
    printable = name if name.isprintable() else ascii(name)[1:-1]
    return printable if len(printable) <= _MAX_SHOWN_LENGTH else f"{printable[:80]}...{printable[-80:]}"


def check_file(path: Path, kind: str, key: str = "") -> Path:
    """Check that a path is a readable regular file within the size limit of its kind, and return it.

    Parameters
    ----------
    path : Path
        Path of the file.
    kind : str
        Kind of file, a key of `MAX_BYTES`.
    key : str, optional
        Key of the request that names the file, for the message.

    Returns
    -------
    Path
        The same path.

    Raises
    ------
    BadInput
        If the file does not exist, is not a regular file, cannot be read or is too large.
    """
    try:
        os.close(_open_descriptor(path, kind))
    except BadInput as error:
        raise BadInput(f"{key}: {error}" if key else str(error)) from None
    return path


@contextmanager
def open_file(path: Path, kind: str) -> Iterator[IO[bytes]]:
    """Open a regular file that is within the size limit of its kind, as a stream of bytes."""
    with os.fdopen(_open_descriptor(path, kind), "rb") as stream:
        yield stream


def _open_descriptor(path: Path, kind: str) -> int:
    try:
        # Opening some devices has effects, so the type is checked before; it is checked again because it may change.
        _check_regular_file(path, kind, os.stat(path))
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except (FileNotFoundError, NotADirectoryError):
        raise BadInput(f"{format_path(path)}: no such file") from None
    except OSError as error:
        raise BadInput(f"{format_path(path)}: {error.strerror}") from None
    except ValueError as error:
        # The path contains a NUL character, or a character that the file system does not support.
        raise BadInput(f"{format_path(path)}: {error}") from None
    try:
        _check_regular_file(path, kind, os.fstat(descriptor))
    except BadInput:
        os.close(descriptor)
        raise
    return descriptor


def _check_regular_file(path: Path, kind: str, status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode):
        file_type = next((word for word, test in _FILE_TYPES if test(status.st_mode)), "not a regular file")
        raise BadInput(f"{format_path(path)}: is {file_type}, but must be a file: a {kind}")
    if status.st_size > MAX_BYTES[kind]:
        raise BadInput(f"{format_path(path)}: is larger than {MAX_BYTES[kind]} bytes, the limit for a {kind}")


_FILE_TYPES = (
    ("a folder", stat.S_ISDIR),
    ("a pipe", stat.S_ISFIFO),
    ("a device", stat.S_ISCHR),
    ("a device", stat.S_ISBLK),
    ("a socket", stat.S_ISSOCK),
)


def read_text(path: Path, kind: str) -> str:
    """Return the text of a UTF-8 file, without the byte order mark that Excel and Notepad write."""
    with open_file(path, kind) as stream:
        # The file may have grown since its size was checked.
        data = stream.read(MAX_BYTES[kind] + 1)
    if len(data) > MAX_BYTES[kind]:
        raise BadInput(f"{format_path(path)}: is larger than {MAX_BYTES[kind]} bytes, the limit for a {kind}")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadInput(f"{format_path(path)}: {error}") from None


@contextmanager
def check_reachable(path: Path) -> Iterator[None]:
    """Turn errors of the operating system about a path into BadInput; a path that does not exist yet is accepted."""
    try:
        yield
        os.lstat(path)
    except FileNotFoundError:
        pass
    except (OSError, RuntimeError, ValueError) as error:
        # Python before 3.13 reports a loop of links as a RuntimeError.
        raise BadInput(f"{format_path(path)}: {getattr(error, 'strerror', None) or error}") from None


def check_target(path: Path, endings: Sequence[str] = ()) -> Path:
    """Check that a file with one of the endings can be written to an existing folder, and return its path."""
    if endings and path.suffix.lower() not in endings:
        raise BadInput(f"{format_path(path)}: the ending is not one of {', '.join(endings)}")
    with check_reachable(path):
        if not path.parent.is_dir():
            raise BadInput(f"{format_path(path)}: its folder does not exist")
        if os.path.lexists(path) and not path.is_file():
            raise BadInput(f"{format_path(path)}: exists and is not a file")
        _refuse_unwritable(path, path.parent)
    return path


def check_folder(path: Path) -> Path:
    """Check that a path is a writable folder, or that a folder can be created there, and return the path."""
    with check_reachable(path):
        if os.path.lexists(path) and not path.is_dir():
            raise BadInput(f"{format_path(path)}: exists and is not a folder")
        nearest = next(candidate for candidate in (path, *path.absolute().parents) if os.path.lexists(candidate))
        if not nearest.is_dir():
            raise BadInput(f"{format_path(path)}: {format_path(nearest)} is not a folder")
        _refuse_unwritable(path, nearest)
    return path


def _refuse_unwritable(path: Path, folder: Path) -> None:
    if not os.access(folder, os.W_OK | os.X_OK):
        raise BadInput(f"{format_path(path)}: its folder is not writable")


@contextmanager
def replace_atomically(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder; what is written there replaces `path` in one rename, or is removed."""
    temporary = path.with_name(f".{os.getpid()}.tmp.{path.name}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


# ------------------------------------------------------------------------------------------------ TOML


def read_toml(path: Path, kind: str) -> dict[str, Any]:
    """Read a TOML file into a dict."""
    try:
        return parse_toml(read_text(path, kind).replace("\r\n", "\n"))
    except ValueError as error:
        # tomllib raises ValueError for a syntax error and for an invalid date.
        raise BadInput(f"{format_path(path)}: {' '.join(str(error).split())}") from None


def parse_toml(source: str) -> dict[str, Any]:
    """Parse a TOML text into a dict.

    Raises
    ------
    ValueError
        If the text is not TOML, or has long keys or deep nesting, on which the parser takes quadratic time or recurses.
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
                raise ValueError(f"a key or number has more than {_MAX_KEY_PARTS} parts (at line {line})")
        elif first in "[{":
            depth, dots = depth + 1, 0
            if depth > _MAX_DEPTH:
                raise ValueError(f"more than {_MAX_DEPTH} nested brackets (at line {line})")
        elif first in "]}":
            depth, dots = depth - 1, 0
        elif first in ",=\n#":
            dots = 0
        elif len(token) > _MAX_WORD_LENGTH and first not in "\"' \t\r":
            raise ValueError(f"a number or key has more than {_MAX_WORD_LENGTH} characters (at line {line})")
        line += token.count("\n")
