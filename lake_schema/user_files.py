"""Open, check and write files that a user names, and parse TOML.

Only regular files are opened: reading a pipe might block, and reading a device might never end. Each type of file, such
as "request" (settings) or "catalogue", has a largest size. All errors are BadInput with one line that names the file.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import stat
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from lake_schema.errors import BadInput
from lake_schema.texts import spelling, toml_mistakes

_MB, _GB = 1 << 20, 1 << 30
# Largest size in bytes of each type of file that a user can name. Catalogues are read in pieces; all other files must
# fit into memory.
MAX_BYTES = {
    "request": _MB,
    "table of pointings": 64 * _MB,
    "curve": 16 * _MB,
    "table of a curve": 4 * _MB,
    "library of spectra": 64 * _MB,
    "spectral series": 128 * _MB,
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
    "model": 4 * _GB,
    "manifest": _GB,
}
# Beginning of an address, such as s3://, of which a path keeps one slash. The drives of Windows have one letter.
_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")
# Largest number of characters of a path in an error message; the middle of a longer path is left out.
_MAX_SHOWN_LENGTH = 200
# Largest number of characters of a path.
_MAX_PATH_LENGTH = 4096
# Largest number of parts of a dotted key (a.b.c) in a TOML text.
_MAX_KEY_PARTS = 16
# Largest number of nested brackets in a TOML text.
_MAX_DEPTH = 16
# Largest number of characters of a number or unquoted key in a TOML text.
_MAX_WORD_LENGTH = 200
# Pattern of one TOML token. A string or comment is one token, so brackets and dots in it are not counted. The pattern
# need not detect wrong syntax, because tomllib does so.
_TOKEN = re.compile(
    r'"""(?:[^"\\]++|\\.|"(?!"")|""(?!"))*+"{3,5}'
    r"|'''(?:[^']++|'(?!'')|''(?!'))*+'{3,5}"
    r'|"(?:[^"\\\n]++|\\.)*+"'
    r"|'[^'\n]*+'"
    r"|#[^\n]*+|[A-Za-z0-9_+-]++|[ \t\r]++|.",
    re.DOTALL,
)


def expand_path(text: str | Path, folder: Path | None = None) -> Path:
    """Return the path for a text that a user typed, with ~ expanded; a relative path starts at `folder` if given.

    Raise BadInput if `text` is not a str or Path, is longer than 4096 characters, or ~ names an unknown user.
    """
    if not isinstance(text, str | Path):
        raise BadInput(f"{format_path(repr(text))} is not a path")
    if len(str(text)) > _MAX_PATH_LENGTH:
        # Refuse long paths, because the time to resolve symbolic links grows with the square of the length.
        raise BadInput(f"{format_path(text)}: File name too long")
    try:
        path = Path(text).expanduser()
    except RuntimeError:
        raise BadInput(f"{format_path(text)}: no such user") from None
    except ValueError as error:
        raise BadInput(f"{format_path(text)}: {error}") from None
    return path if folder is None else folder / path


def format_path(path: str | Path) -> str:
    """Return a path for an error message: one line of at most 200 printable characters.

    If the path has more than 200 characters, its first and last 80 are shown with "..." between them.
    """
    name = str(path)
    printable = name if name.isprintable() else ascii(name)[1:-1]
    return printable if len(printable) <= _MAX_SHOWN_LENGTH else f"{printable[:80]}...{printable[-80:]}"


def check_file(path: Path, kind: str, key: str = "") -> Path:
    """Check that a path is a readable regular file of at most a given size, and return the path.

    Parameters
    ----------
    path : Path
        Path of the file.
    kind : str
        Type of file, a key of `MAX_BYTES`, such as "catalogue". It determines the largest size.
    key : str, optional
        Name of the setting that contains the path, for the message.

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
    """Open a regular file as a stream of bytes for the body of a `with` statement.

    `kind` is the type of file, a key of `MAX_BYTES`, which determines the largest size. BadInput is raised if the file
    does not exist, is not a regular file, cannot be opened, or is too large.
    """
    with os.fdopen(_open_descriptor(path, kind), "rb") as stream:
        yield stream


def _open_descriptor(path: Path, kind: str) -> int:
    try:
        # Check the type before opening, because opening some devices has side effects. Check it again below, because
        # another process may replace the file in between.
        _check_regular_file(path, kind, os.stat(path))
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except (FileNotFoundError, NotADirectoryError):
        raise BadInput(f"{format_path(path)}: no such file{suggest_similar(path, path.suffix)}") from None
    except OSError as error:
        raise BadInput(f"{format_path(path)}: {error.strerror}") from None
    except ValueError as error:
        # Possible reasons: a NUL character in the path, or a character that the file system does not support.
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
        form = "TOML file" if kind == "request" else f"file: a {kind}"
        raise BadInput(f"{format_path(path)}: is {file_type}, but must be a {form}")
    if status.st_size > MAX_BYTES[kind]:
        raise BadInput(f"{format_path(path)}: is larger than {MAX_BYTES[kind]} bytes, the limit for a {kind}")


_FILE_TYPES = (
    ("a folder", stat.S_ISDIR),
    ("a pipe", stat.S_ISFIFO),
    ("a device", stat.S_ISCHR),
    ("a device", stat.S_ISBLK),
    ("a socket", stat.S_ISSOCK),
)


def read_bytes(path: Path, kind: str) -> bytes:
    """Return the contents of a regular file.

    `kind` is the type of file, a key of `MAX_BYTES`. BadInput is raised if the file cannot be read, is larger than the
    limit of its type, or grows while it is read.
    """
    with open_file(path, kind) as stream:
        size = os.fstat(stream.fileno()).st_size
        data = stream.read(size + 1)
    if len(data) > size:
        raise BadInput(f"{format_path(path)}: has grown while it was read")
    return data


def read_text(path: Path, kind: str) -> str:
    """Return the text of a UTF-8 file, without the byte order mark that Excel and Notepad write at its start.

    `kind` is the type of file, a key of `MAX_BYTES`. BadInput is raised if the file cannot be read, is larger than the
    limit of its type, grows while it is read, or is not UTF-8.
    """
    try:
        return read_bytes(path, kind).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadInput(f"{format_path(path)}: {error}") from None


@contextmanager
def check_reachable(path: Path) -> Iterator[None]:
    """Raise BadInput in place of errors of the operating system about a path in the body of a `with` statement.

    At the end of the body, the path is looked up on disc, so that one that is too long raises BadInput, for example. A
    path that does not exist is accepted.
    """
    try:
        yield
        os.lstat(path)
    except FileNotFoundError:
        pass
    except (OSError, RuntimeError, ValueError) as error:
        # RuntimeError: Python before 3.13 raises it for a loop of symbolic links.
        raise BadInput(f"{format_path(path)}: {getattr(error, 'strerror', None) or error}") from None


def suggest_similar(path: Path, ending: str) -> str:
    """Return "; did you mean X?" for a missing file, or "" if the file exists or no name in its folder is similar.

    X is the file with the most similar name among those with an ending such as ".toml", or with a similar ending. If
    the folder does not exist, the folder with the most similar name is searched.
    """
    try:
        folder = _nearest_folder(path.parent)
        entries = [] if folder is None or path.exists() else sorted(folder.iterdir())
    except (OSError, ValueError):
        return ""
    stems = {entry.stem: entry for entry in entries if entry.name.endswith(ending)}
    if not (names := spelling.closest_names(path.stem, stems, 1)):
        endings = [entry.suffix for entry in entries if entry.suffix != ending]
        similar = spelling.closest_names(ending, endings, 1)
        stems = {entry.name: entry for entry in entries if entry.suffix in similar}
        names = spelling.closest_names(path.name, stems, 1)
    return f"; did you mean {format_path(stems[names[0]])}?" if names else ""


def _nearest_folder(folder: Path) -> Path | None:
    """Return a folder, or the one with the most similar path if it does not exist, else None."""
    # A loop and not a recursion, because a path may have thousands of parts.
    missing: list[str] = []
    while not folder.is_dir() and folder != folder.parent:
        missing.append(folder.name)
        folder = folder.parent
    for name in reversed(missing):
        renamed = folder / name
        if not renamed.is_dir():
            similar = similar_folder(renamed)
            if similar is None:
                return None
            renamed = similar
        folder = renamed
    return folder


def similar_folder(path: Path) -> Path | None:
    """Return the folder whose name is most similar to that of a missing folder in the same place, else None."""
    with contextlib.suppress(OSError):
        names = [entry.name for entry in path.parent.iterdir() if entry.is_dir()]
        if similar := spelling.closest_names(path.name, names, 1):
            return path.with_name(similar[0])
    return None


def check_target(path: Path, endings: Sequence[str] = ()) -> Path:
    """Check that a file can be written at a path, and return the path. The file itself may exist and be replaced.

    `endings` are the allowed endings in lower case, such as ".fits"; by default any ending is allowed. BadInput is
    raised for another ending, or if the folder does not exist or is not writable, or the path is a folder or device.
    """
    if endings and path.suffix.lower() not in endings:
        raise BadInput(f"{format_path(path)}: the name of the file must end in {spelling.join_words(endings)}")
    with check_reachable(path):
        if not path.parent.is_dir():
            raise BadInput(f"{format_path(path)}: its folder does not exist")
        if os.path.lexists(path) and not path.is_file():
            raise BadInput(f"{format_path(path)}: exists and is not a file")
        _refuse_unwritable(path, path.parent)
    return path


def check_folder(path: Path) -> Path:
    """Check that a path is a writable folder, or that a folder can be created there, and return the path.

    Raise BadInput otherwise. Nothing is created.
    """
    if _ADDRESS.match(str(path)):
        raise BadInput(f"{format_path(path)}: files are written to a local folder; give its path, not an address")
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
    """Yield a temporary path in the folder of `path`, to which the body of the `with` statement must write a file.

    At the end, the file is renamed to `path`, which it replaces. If the body raises an exception, the file is removed
    and `path` is not changed.
    """
    temporary = path.with_name(f".{os.getpid()}.tmp.{path.name}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def create_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder next to `path`, which the body of the `with` statement must fill.

    At the end, it is renamed to `path`, which must not exist. If the body raises an exception, the folder is removed.
    Folders above `path` that do not exist are created. BadInput is raised if the folder cannot be renamed; it is then
    kept, and the message names it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{os.getpid()}.tmp.{path.name}")
    temporary.mkdir()
    try:
        yield temporary
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    try:
        os.rename(temporary, path)
    except OSError as error:
        where = format_path(temporary)
        raise BadInput(f"{format_path(path)}: {error.strerror}; the complete folder is {where}") from None


# ------------------------------------- parsing of TOML texts


def read_toml(path: Path, kind: str) -> dict[str, Any]:
    """Read a TOML file into a dict; raise BadInput if it cannot be read, is too large, or is not valid TOML.

    `kind` is the type of file, a key of `MAX_BYTES`, which determines the largest size.
    """
    source = read_text(path, kind).replace("\r\n", "\n")
    try:
        return parse_toml(source)
    except ValueError as error:
        # tomllib raises a ValueError for a syntax error and also for an invalid date.
        problem = toml_mistakes.explain(source, error)
        raise BadInput(f"{format_path(path)}{' ' if problem.startswith('line ') else ': '}{problem}") from None


def parse_toml(source: str) -> dict[str, Any]:
    """Parse a TOML text into a dict.

    Raises
    ------
    ValueError
        If the text is not valid TOML. Also for keys of more than 16 parts, more than 16 nested brackets, and numbers or
        keys above 200 characters, for which tomllib would be very slow or exceed Python's recursion limit.
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
