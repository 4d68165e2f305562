"""Paths of the files in a lake (a folder of versioned tables), and checks of names in these paths.

A name from a user cannot lead to a file outside the lake. A request is a named set of settings for a simulation; it has
one version of each table. The layout of a lake is::

    LAKE/<table>/current -> v-<key>               the version that was published last, of any request
    LAKE/names/<name>/<table> -> ../../<table>/v-<key>    the version of a request
    LAKE/<table>/v-<key>/manifest.json            all files of the version with rows, bytes and sha256
    LAKE/<table>/v-<key>/<table>/dataset/...      a HATS catalogue, with <table>_margin/ and collection.properties
    LAKE/<table>/v-<key>/dataset/<part>.parquet   any other table
    LAKE/<table>/v-<key>/images/...               files that belong to rows
    LAKE/<table>/.stage-<key>/                    a version that is being made
    LAKE/<table>/.receipts-<key>/                 JSON records of its finished files, and rows near the edges of cells
    LAKE/<table>/.lock, .lock-<key>               locks for publishing, and for making a version
    LAKE/<table>/.gone*                           folders that are being removed
    LAKE/runs/<id>.jsonl                          log of a run
"""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import unquote

from lake_schema import tables, user_files
from lake_schema.errors import BadInput, Damaged, PartOfLake
from lake_schema.store.object_storage import s3
from lake_schema.store.object_storage.s3 import Below, Folder, ObjectPath
from lake_schema.texts import spelling

_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}", re.ASCII)
_CELL_PATH = re.compile(r"Norder=(\d+)/Dir=\d+/Npix=(\d+)\.parquet", re.ASCII)
_VERSION_LINK = re.compile(r"(?:\.\./\.\./(?P<table>[a-z0-9_-]+)/)?v-(?P<key>[0-9a-f]{16})", re.ASCII)
_NAMES, _RUNS = "names", "runs"
_REMOTE_ADDRESS = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]+:/")
# Numbers of the errors of the operating system that mean that a file or folder cannot be written.
UNWRITABLE = (errno.EROFS, errno.EACCES, errno.EPERM)
_FILE_URL = re.compile(r"file:(?://(?:localhost)?)?(/(?!/).*)", re.IGNORECASE | re.DOTALL)


def check_name(text: str) -> str:
    """Return `text` if it is a valid name of a table, of a request (named settings) or of a file.

    Parameters
    ----------
    text : str
        The name. A valid name has 1 to 64 characters: lower-case letters, digits, _ and -, beginning with a letter or
        digit.

    Returns
    -------
    str
        The unchanged text.

    Raises
    ------
    BadInput
        If the name is not valid.
    """
    if not is_name(text):
        raise BadInput(f"name {str(text)[:100]!r} is not of the form [a-z0-9][a-z0-9_-]* with at most 64 characters")
    return text


def is_name(text: object) -> bool:
    """Return True if `text` is a valid name of a table, of a request (named settings) or of a file.

    Parameters
    ----------
    text : object
        The name. A valid name has 1 to 64 characters: lower-case letters, digits, _ and -, beginning with a letter or
        digit.

    Returns
    -------
    bool
        True if the name is valid; False if it is not a str.
    """
    return isinstance(text, str) and _NAME.fullmatch(text) is not None


def resolve_lake(text: str | Path) -> Path:
    """Return the absolute path of a lake's folder, which need not exist yet; links are followed.

    Parameters
    ----------
    text : str or Path
        Path of the folder. Users of Spark may write file:///a/b for /a/b. Addresses of object storage, such as
        s3://bucket, are refused, because tables are published by renames of folders.

    Returns
    -------
    Path
        The absolute path.

    Raises
    ------
    BadInput
        If the path is empty, an address of object storage, an existing file, or not allowed by the file system.
    PartOfLake
        If the folder is a part of a lake, such as a table.
    """
    if local := _FILE_URL.fullmatch(str(text)):
        text = unquote(local[1])
    if not str(text):
        raise BadInput("lake: its path is empty")
    if _REMOTE_ADDRESS.match(str(text)):
        raise BadInput(
            f"lake {user_files.format_path(s3.remove_secrets(str(text)))}: only a POSIX file system can publish by "
            "rename; mount it and give the path"
            + (", and truesky push puts the lake there when it is made" if s3.is_address(text) else "")
        )
    try:
        root = user_files.expand_path(text).resolve()
        # Check that the file system accepts the path: `os.lstat` raises an error if it is too long, for example.
        os.lstat(root)
        if not root.is_dir():
            raise BadInput(f"lake {user_files.format_path(text)} is not a folder")
        _refuse_part_of_lake(text, root)
    except FileNotFoundError:
        pass
    except (OSError, RuntimeError, ValueError) as error:
        # Possible reasons: a loop of symbolic links, a path that is too long, or a NUL character in the path.
        raise BadInput(f"lake {user_files.format_path(text)}: {getattr(error, 'strerror', None) or error}") from None
    return root


def _refuse_part_of_lake(text: str | Path, root: Path) -> None:
    """Raise PartOfLake if a folder is in a lake; `text` is its path as the user typed it, `root` the absolute path."""
    for lake in root.parents:
        first, *rest = root.relative_to(lake).parts
        is_part = first in (_NAMES, _RUNS) or tables.find_table(first) is not None
        # A lake may itself be in a folder with the name of a table.
        if is_part and any(tables.find_table(name) for name in table_names(lake)) and not table_names(root):
            typed = user_files.expand_path(text)
            typed_lake = next((folder for folder in (typed, *typed.parents) if folder.resolve() == lake), lake)
            name = user_files.format_path(typed_lake)
            request = rest[0] if first == _NAMES and rest else ""
            raise PartOfLake(f"lake {user_files.format_path(text)} is a part of the lake {name}: give {name}", request)


def open_lake(text: str | Folder, endpoint: str | None = None) -> Folder:
    """Return the root of a lake for reading: a folder, or a location on object storage.

    Parameters
    ----------
    text : str, Path or ObjectPath
        Path of the lake, or its address on object storage, s3://BUCKET/PREFIX.
    endpoint : str, optional
        URL of the object storage, for an address only. By default it is taken from the address, else from
        $AWS_ENDPOINT_URL_S3 or $AWS_ENDPOINT_URL, else it is Amazon S3. It is ignored if `text` is an ObjectPath.

    Returns
    -------
    Path or ObjectPath
        The root. Whether a lake exists there is not checked.

    Raises
    ------
    BadInput
        If the path or address is not valid, or if a path is given with an endpoint.
    """
    if isinstance(text, ObjectPath):
        return text.reopen()
    if s3.is_address(text):
        return ObjectPath(s3.ObjectStore(s3.parse_address(str(text), endpoint)))
    if endpoint is not None:
        raise BadInput(f"lake {user_files.format_path(text)} is not an address s3://.., so it cannot have an endpoint")
    return resolve_lake(text)


def table_folder(root: Below, table_name: str) -> Below:
    """Return the folder of a table in a lake.

    Parameters
    ----------
    root : Path or ObjectPath
        Root of the lake.
    table_name : str
        Name of the table.

    Returns
    -------
    Path or ObjectPath
        The folder, which need not exist.

    Raises
    ------
    BadInput
        If the name is not valid or leads out of the lake.
    """
    return check_inside(root, root / check_name(table_name))


def stage_folder(root: Path, table_name: str, key: str) -> Path:
    """Return the hidden folder (stage) in which a version of a table is made before it is published.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    table_name : str
        Name of the table.
    key : str
        Key of the version (hash of everything that determines its contents).

    Returns
    -------
    Path
        The folder, which need not exist.
    """
    return table_folder(root, table_name) / f".stage-{check_name(key)}"


def version_folder(root: Below, table_name: str, key: str) -> Below:
    """Return the folder of a published version of a table.

    Parameters
    ----------
    root : Path or ObjectPath
        Root of the lake.
    table_name : str
        Name of the table.
    key : str
        Key of the version (hash of everything that determines its contents).

    Returns
    -------
    Path or ObjectPath
        The folder, which need not exist.

    Raises
    ------
    BadInput
        If a name is not valid, or the folder is a link that leads out of the lake.
    """
    return check_inside(root, root / check_name(table_name) / f"v-{check_name(key)}")


def current_link(root: Below, table_name: str) -> Below:
    """Return the path of the symbolic link to the version of a table that was published last.

    Parameters
    ----------
    root : Path or ObjectPath
        Root of the lake.
    table_name : str
        Name of the table.

    Returns
    -------
    Path or ObjectPath
        The link, which need not exist.
    """
    return table_folder(root, table_name) / "current"


def requests_folder(root: Below) -> Below:
    """Return the folder that contains one folder per request (named set of settings of a simulation).

    The folder of a request contains one symbolic link per table, to the version that belongs to the request.

    Parameters
    ----------
    root : Path or ObjectPath
        Root of the lake.

    Returns
    -------
    Path or ObjectPath
        The folder, which need not exist.
    """
    return check_inside(root, root / _NAMES)


def request_folder(root: Below, request: str) -> Below:
    """Return the folder with the links of a request (named set of settings), which need not exist.

    Parameters
    ----------
    root : Path or UPath
        Folder of the lake.
    request : str
        Name of the request.

    Returns
    -------
    Path or UPath
        The folder.

    Raises
    ------
    BadInput
        If the name is not valid, or if the folder is a link that leads out of the lake.
    """
    return check_inside(root, requests_folder(root) / check_name(request))


def request_link(root: Below, request: str, table_name: str) -> Below:
    """Return the path of the symbolic link from a request to its version of a table.

    Parameters
    ----------
    root : Path or ObjectPath
        Root of the lake.
    request : str
        Name of the request (named set of settings of a simulation).
    table_name : str
        Name of the table.

    Returns
    -------
    Path or ObjectPath
        The link, which need not exist.
    """
    return request_folder(root, request) / check_name(table_name)


def table_names(root: Folder) -> list[str]:
    """Return the names of the tables in a lake that have a link `current`.

    Parameters
    ----------
    root : Path or ObjectPath
        Root of the lake.

    Returns
    -------
    list of str
        Sorted names. A name is also returned if the link leads to a version that has been removed. The list is empty
        without a lake.
    """
    reserved = {_NAMES, _RUNS}
    folders = [p for p in root.iterdir() if is_name(p.name) and p.name not in reserved] if root.is_dir() else []
    return sorted(
        path.name for path in folders if path.is_dir() and any(entry.name == "current" for entry in path.iterdir())
    )


def missing_table(root: Folder, table_name: str = "", existing: Sequence[str] = (), owner: str = "") -> BadInput:
    """Return the error for a table that a lake does not have, or for a lake without tables.

    Parameters
    ----------
    root : Path or ObjectPath
        Root of the lake.
    table_name : str, optional
        Name of the missing table. Without a name, the message says that there is no lake.
    existing : sequence of str, optional
        Names of the tables that exist.
    owner : str, optional
        End of the description of the table, such as " of request demo".

    Returns
    -------
    BadInput
        The error, with the most similar name or all names of tables.
    """
    if isinstance(root, Path) and not root.exists():
        similar = user_files.similar_folder(root)
        remedy = f"did you mean {similar}?" if similar else f"make it with truesky run REQUEST {root}"
        return BadInput(f"lake {root} does not exist; {remedy}")
    if table_name:
        # A table that truesky can make is not misspelt.
        question = "" if tables.find_table(table_name) else spelling.did_you_mean(table_name, existing)
        owners = [name for name in existing if (table := tables.find_table(name)) and table_name in table.names]
        if owners and not question:
            question = f"{table_name} is a column of {spelling.join_words(owners, 'and')}"
        remedy = question or f"it has {', '.join(existing) or 'no tables'}"
        return BadInput(f"lake {root} has no table {table_name}{owner}; {remedy}")
    return BadInput(f"{root} is not a lake, because it has no tables; give a folder that truesky run has made")


def current_key(root: Folder, table_name: str) -> str | None:
    """Return the key of the version of a table that was published last.

    Parameters
    ----------
    root : Path or ObjectPath
        Root of the lake.
    table_name : str
        Name of the table.

    Returns
    -------
    str or None
        Key of the version, or None if the link `current` does not exist. Whether the folder of the version still exists
        is not checked.

    Raises
    ------
    Damaged
        If `current` is not a link to a version in the same folder.
    """
    return linked_key(current_link(root, table_name), "")


def linked_key(link: Folder, table_name: str) -> str | None:
    """Return the key of the version to which a symbolic link leads, or None if the link does not exist.

    Parameters
    ----------
    link : Path or ObjectPath
        The link.
    table_name : str
        Name of the table that the target of the link must contain (../../<table>/v-<key>), or "" if the target must be
        a version in the folder of the link (v-<key>).

    Returns
    -------
    str or None
        Key of the version, 16 hexadecimal digits. Whether the version exists is not checked.

    Raises
    ------
    Damaged
        If the file is not a link to a version of the table.
    """
    try:
        match = _VERSION_LINK.fullmatch(link.readlink() if isinstance(link, ObjectPath) else os.readlink(link))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise Damaged(f"{link} is not a link ({error.strerror}): a copy of a lake must keep its links") from None
    if match is None or (match["table"] or "") != table_name:
        raise Damaged(f"{link} does not lead to a version of table {table_name or link.parent.name}")
    return match["key"]


def runs_folder(root: Below) -> Below:
    """Return the folder of a lake in which every run of a job writes its log.

    Parameters
    ----------
    root : Path or ObjectPath
        Root of the lake.

    Returns
    -------
    Path or ObjectPath
        The folder, which need not exist.
    """
    return check_inside(root, root / _RUNS)


def cell_file(order: int, cell: int) -> str:
    """Return the path of the file of a nested HEALPix cell below dataset/, in the form that HATS requires.

    Parameters
    ----------
    order : int
        HEALPix order.
    cell : int
        Nested index of the cell.

    Returns
    -------
    str
        Path such as "Norder=5/Dir=0/Npix=8983.parquet".
    """
    return f"Norder={order}/Dir={cell // 10_000 * 10_000}/Npix={cell}.parquet"


def cell_of_file(partition: str) -> tuple[int, int]:
    """Return the HEALPix order and the nested cell of the path of a file.

    Parameters
    ----------
    partition : str
        A path from `cell_file`.

    Returns
    -------
    tuple of int
        Order and nested index of the cell.

    Raises
    ------
    BadInput
        If the path does not have the form of `cell_file`.
    """
    match = _CELL_PATH.fullmatch(partition)
    if match is None or cell_file(int(match[1]), int(match[2])) != partition:
        raise BadInput(f"{partition} is not the path of a cell")
    return int(match[1]), int(match[2])


def check_inside(root: Below, path: Below) -> Below:
    """Return a path if it is inside a folder after symbolic links are followed.

    Parameters
    ----------
    root : Path or ObjectPath
        The folder.
    path : Path or ObjectPath
        The path, which may be the folder itself. Paths on object storage are not checked.

    Returns
    -------
    Path or ObjectPath
        The unchanged path.

    Raises
    ------
    BadInput
        If the path leads out of the folder.
    """
    if isinstance(path, ObjectPath) or isinstance(root, ObjectPath):
        # Object storage has no symbolic links, and all names in these paths were checked before.
        return path
    try:
        inside = path.resolve().is_relative_to(root.resolve())
    except (OSError, RuntimeError, ValueError) as error:
        raise BadInput(f"path {user_files.format_path(path)}: {getattr(error, 'strerror', None) or error}") from None
    if not inside:
        raise BadInput(f"path {user_files.format_path(path)} is outside {root}")
    return path


@contextmanager
def report_unwritable(root: Path) -> Iterator[None]:
    """Raise BadInput in the body of a `with` statement if the operating system does not allow writing to a lake.

    Parameters
    ----------
    root : Path
        Folder of the lake, which the message names.

    Yields
    ------
    None
        Nothing.

    Raises
    ------
    BadInput
        If the body raises such an error for a file of the lake. Errors that concern other files are not changed.
    """
    try:
        yield
    except OSError as error:
        path = root if error.filename is None else Path(os.fsdecode(error.filename))
        # If the lake does not exist yet, the error concerns a folder above it.
        if error.errno not in UNWRITABLE or not (path.is_relative_to(root) or root.is_relative_to(path)):
            raise
        place = "" if path == root else f": {user_files.format_path(path)}"
        raise BadInput(f"lake {root} cannot be written{place}: {error.strerror}") from None
