"""Paths of a lake's files, and checks of names; names that lead out of the lake are refused here.

The layout of a lake is::

    LAKE/<table>/current -> v-<key>               the version that was published last, of any request
    LAKE/names/<name>/<table> -> ../../<table>/v-<key>    the version of a request
    LAKE/<table>/v-<key>/manifest.json            all files of the version with rows, bytes and sha256
    LAKE/<table>/v-<key>/<table>/dataset/...      a HATS catalogue, with <table>_margin/ and collection.properties
    LAKE/<table>/v-<key>/dataset/<part>.parquet   any other table
    LAKE/<table>/v-<key>/images/...               files that belong to rows
    LAKE/<table>/.stage-<key>/                    a version that is being made
    LAKE/<table>/.receipts-<key>/                 receipts of its finished tasks, and the border rows of its cells
    LAKE/<table>/.lock, .lock-<key>               locks for publishing, and for making a version
    LAKE/<table>/.gone*                           folders that are being removed
    LAKE/runs/<id>.jsonl                          log of a run
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from urllib.parse import unquote

from lake_schema import user_files
from lake_schema.errors import BadInput, Damaged
from lake_schema.store.object_storage import s3
from lake_schema.store.object_storage.s3 import Below, Folder, ObjectPath

_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}", re.ASCII)
_CELL_PATH = re.compile(r"Norder=(\d+)/Dir=\d+/Npix=(\d+)\.parquet", re.ASCII)
_VERSION_LINK = re.compile(r"(?:\.\./\.\./(?P<table>[a-z0-9_-]+)/)?v-(?P<key>[0-9a-f]{16})", re.ASCII)
_NAMES, _RUNS = "names", "runs"
_REMOTE_ADDRESS = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]+:/")
_FILE_URL = re.compile(r"file:(?://(?:localhost)?)?(/(?!/).*)", re.IGNORECASE | re.DOTALL)


def check_name(text: str) -> str:
    """Return `text` if it is a valid name of a table, request or file stem, else raise BadInput."""
    if not is_name(text):
        raise BadInput(f"name {str(text)[:100]!r} is not of the form [a-z0-9][a-z0-9_-]* with at most 64 characters")
    return text


def is_name(text: object) -> bool:
    """Return True if `text` is a valid name."""
    return isinstance(text, str) and _NAME.fullmatch(text) is not None


def resolve_lake(text: str | Path) -> Path:
    """Return the absolute path of a lake's folder, which need not exist yet.

    file:///a/b is accepted for /a/b, as Spark's users write it. Addresses of object storage are refused, because
    publishing requires renames.
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
        # The path must be missing or a folder; the file system may refuse the name.
        os.lstat(root)
        if not root.is_dir():
            raise BadInput(f"lake {user_files.format_path(text)} is not a folder")
    except FileNotFoundError:
        pass
    except (OSError, RuntimeError, ValueError) as error:
        # Reasons are a loop of links, a path that is too long, or a NUL character.
        raise BadInput(f"lake {user_files.format_path(text)}: {getattr(error, 'strerror', None) or error}") from None
    return root


def open_lake(text: str | Folder, endpoint: str | None = None) -> Folder:
    """Return the root of a lake for reading: a folder, or a location on object storage.

    Parameters
    ----------
    text : str, Path or ObjectPath
        Path or address of the lake.
    endpoint : str, optional
        URL of the object storage; by default that of the address or of $AWS_ENDPOINT_URL.

    Returns
    -------
    Path or ObjectPath
        The root. It is not checked that a lake exists there.

    Raises
    ------
    BadInput
        If the path or address is wrong.
    """
    if isinstance(text, ObjectPath):
        return text.reopen()
    if s3.is_address(text):
        return ObjectPath(s3.ObjectStore(s3.parse_address(str(text), endpoint)))
    if endpoint is not None:
        raise BadInput(f"lake {user_files.format_path(text)} is not an address s3://.., so it cannot have an endpoint")
    return resolve_lake(text)


def table_folder(root: Below, table_name: str) -> Below:
    """Return the folder of a table."""
    return check_inside(root, root / check_name(table_name))


def stage_folder(root: Path, table_name: str, key: str) -> Path:
    """Return the folder of a version that is being made.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    table_name : str
        Name of the table.
    key : str
        Key of the version.

    Returns
    -------
    Path
        The folder, which need not exist.
    """
    return table_folder(root, table_name) / f".stage-{check_name(key)}"


def version_folder(root: Below, table_name: str, key: str) -> Below:
    """Return the folder of a published version.

    Parameters
    ----------
    root : Path or ObjectPath
        Root of the lake.
    table_name : str
        Name of the table.
    key : str
        Key of the version.

    Returns
    -------
    Path or ObjectPath
        The folder, which need not exist.
    """
    return table_folder(root, table_name) / f"v-{check_name(key)}"


def current_link(root: Below, table_name: str) -> Below:
    """Return the link to the version that was published last."""
    return table_folder(root, table_name) / "current"


def requests_folder(root: Below) -> Below:
    """Return the folder with one folder per request, which contains the links to the request's tables."""
    return check_inside(root, root / _NAMES)


def request_link(root: Below, request: str, table_name: str) -> Below:
    """Return the link of a request to its version of a table.

    Parameters
    ----------
    root : Path or ObjectPath
        Root of the lake.
    request : str
        Name of the request.
    table_name : str
        Name of the table.

    Returns
    -------
    Path or ObjectPath
        The link, which need not exist.
    """
    return requests_folder(root) / check_name(request) / check_name(table_name)


def table_names(root: Folder) -> list[str]:
    """Return the sorted names of all tables that have been published, even if the version has been removed since."""
    reserved = {_NAMES, _RUNS}
    folders = [p for p in root.iterdir() if is_name(p.name) and p.name not in reserved] if root.is_dir() else []
    return sorted(
        path.name for path in folders if path.is_dir() and any(entry.name == "current" for entry in path.iterdir())
    )


def current_key(root: Folder, table_name: str) -> str | None:
    """Return the key of the version that was published last, or None if nothing has been published.

    The version itself may be missing.

    Raises
    ------
    Damaged
        If `current` is not a link to a version in the same folder.
    """
    return linked_key(current_link(root, table_name), "")


def linked_key(link: Folder, table_name: str) -> str | None:
    """Return the key of the version to which a link leads, or None if the link does not exist.

    Parameters
    ----------
    link : Path or ObjectPath
        The link.
    table_name : str
        Table in the link's target, or "" if the version is in the folder of the link.

    Returns
    -------
    str or None
        Key of the version.

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
    """Return the folder of the run logs."""
    return check_inside(root, root / _RUNS)


def cell_file(order: int, cell: int) -> str:
    """Return the path of a cell's file below dataset/, as HATS requires."""
    return f"Norder={order}/Dir={cell // 10_000 * 10_000}/Npix={cell}.parquet"


def cell_of_file(partition: str) -> tuple[int, int]:
    """Return the order and the cell of a path from `cell_file`."""
    match = _CELL_PATH.fullmatch(partition)
    if match is None or cell_file(int(match[1]), int(match[2])) != partition:
        raise BadInput(f"{partition} is not the path of a cell")
    return int(match[1]), int(match[2])


def check_inside(root: Below, path: Below) -> Below:
    """Return `path` if it is in `root` after links are followed, else raise BadInput."""
    if isinstance(path, ObjectPath) or isinstance(root, ObjectPath):
        # Paths on object storage consist of checked names, and there are no links.
        return path
    try:
        inside = path.resolve().is_relative_to(root.resolve())
    except (OSError, RuntimeError, ValueError) as error:
        raise BadInput(f"path {user_files.format_path(path)}: {getattr(error, 'strerror', None) or error}") from None
    if not inside:
        raise BadInput(f"path {user_files.format_path(path)} is outside {root}")
    return path
