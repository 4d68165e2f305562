"""The one grammar of paths in a lake; a name that could leave the lake is refused here.

LAKE/<table>/current -> v-<key>               the version that was published last, whichever request it belongs to
LAKE/names/<name>/<table> -> ../../<table>/v-<key>    the version that belongs to a request
LAKE/<table>/v-<key>/manifest.json            every file of the version with rows, bytes and sha256
LAKE/<table>/v-<key>/<table>/dataset/...      a catalogue: HATS, beside <table>_margin/ and collection.properties
LAKE/<table>/v-<key>/dataset/<part>.parquet   any other table
LAKE/<table>/v-<key>/images/...               files that belong to rows
LAKE/<table>/.stage-<key>/                    a version in the making
LAKE/<table>/.receipts-<key>/                 what is done of it, and the rows along the borders of its cells
LAKE/<table>/.lock, .lock-<key>               held while publishing, while making a version
LAKE/<table>/.gone*                           on its way out
LAKE/runs/<id>.jsonl                          what each run did
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
    """`text` where it is a legal name of a table, request or file stem; else BadInput."""
    if not is_name(text):
        raise BadInput(f"name {str(text)[:100]!r} is not of the form [a-z0-9][a-z0-9_-]* with at most 64 characters")
    return text


def is_name(text: object) -> bool:
    """Is it a legal name?"""
    return isinstance(text, str) and _NAME.fullmatch(text) is not None


def resolve_lake(text: str | Path) -> Path:
    """The root of a lake: a folder of a POSIX file system, absolute; object stores are refused (they cannot rename).

    It need not be there yet.  file:///a/b is /a/b, as Spark's users write it.
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
        # Not there, or a folder: anything else, and a name that the file system does not hold, is refused.
        os.lstat(root)
        if not root.is_dir():
            raise BadInput(f"lake {user_files.format_path(text)} is not a folder")
    except FileNotFoundError:
        pass
    except (OSError, RuntimeError, ValueError) as error:
        # A circle of links, a path too long, a NUL.
        raise BadInput(f"lake {user_files.format_path(text)}: {getattr(error, 'strerror', None) or error}") from None
    return root


def open_lake(text: str | Folder, endpoint: str | None = None) -> Folder:
    """The root of a lake that is only read: a folder, or a place on object storage that one was pushed to.

    endpoint : URL of the object storage, None = what the address or $AWS_ENDPOINT_URL says
    Errors   : BadInput; whether a lake is there is found out when it is read
    """
    if isinstance(text, ObjectPath):
        return text.reopen()
    if s3.is_address(text):
        return ObjectPath(s3.ObjectStore(s3.parse_address(str(text), endpoint)))
    if endpoint is not None:
        raise BadInput(f"lake {user_files.format_path(text)} is no address s3://..: an endpoint does not go with it")
    return resolve_lake(text)


def table_folder(root: Below, table_name: str) -> Below:
    """Folder of a table."""
    return check_inside(root, root / check_name(table_name))


def stage_folder(root: Path, table_name: str, key: str) -> Path:
    """Folder of a version in the making."""
    return table_folder(root, table_name) / f".stage-{check_name(key)}"


def version_folder(root: Below, table_name: str, key: str) -> Below:
    """Folder of a published version."""
    return table_folder(root, table_name) / f"v-{check_name(key)}"


def current_link(root: Below, table_name: str) -> Below:
    """The link to the published version."""
    return table_folder(root, table_name) / "current"


def requests_folder(root: Below) -> Below:
    """Folder of the requests, in each of which are links to its tables."""
    return check_inside(root, root / _NAMES)


def request_link(root: Below, request: str, table_name: str) -> Below:
    """The link of a request to its version of a table."""
    return requests_folder(root) / check_name(request) / check_name(table_name)


def table_names(root: Folder) -> list[str]:
    """Names of the tables that have been published, sorted; also of one whose version has gone since."""
    reserved = {_NAMES, _RUNS}
    folders = [p for p in root.iterdir() if is_name(p.name) and p.name not in reserved] if root.is_dir() else []
    return sorted(
        path.name for path in folders if path.is_dir() and any(entry.name == "current" for entry in path.iterdir())
    )


def current_key(root: Folder, table_name: str) -> str | None:
    """Key of the version that was published last, which may be missing; None where nothing has been published.

    Errors : Damaged where `current` is not a link to a version beside it
    """
    return linked_key(current_link(root, table_name), "")


def linked_key(link: Folder, table_name: str) -> str | None:
    """Key of the version that a link leads to, None where there is no link; Damaged where it leads elsewhere.

    table_name : where the version stands, as seen from the link; "" = beside it
    """
    try:
        match = _VERSION_LINK.fullmatch(link.readlink() if isinstance(link, ObjectPath) else os.readlink(link))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise Damaged(f"{link} is no link ({error.strerror}): a copy of a lake must keep its links") from None
    if match is None or (match["table"] or "") != table_name:
        raise Damaged(f"{link} does not lead to a version of table {table_name or link.parent.name}")
    return match["key"]


def runs_folder(root: Below) -> Below:
    """Folder of the run logs."""
    return check_inside(root, root / _RUNS)


def cell_file(order: int, cell: int) -> str:
    """Path of a cell's file below dataset/, as HATS wants it."""
    return f"Norder={order}/Dir={cell // 10_000 * 10_000}/Npix={cell}.parquet"


def cell_of_file(partition: str) -> tuple[int, int]:
    """The order and cell of a path that `cell_file` made."""
    match = _CELL_PATH.fullmatch(partition)
    if match is None or cell_file(int(match[1]), int(match[2])) != partition:
        raise BadInput(f"{partition} is not the path of a cell")
    return int(match[1]), int(match[2])


def check_inside(root: Below, path: Below) -> Below:
    """`path` where, links followed, it lies in `root`; else BadInput."""
    if isinstance(path, ObjectPath) or isinstance(root, ObjectPath):
        # Made of names that were checked, in a storage without links.
        return path
    try:
        inside = path.resolve().is_relative_to(root.resolve())
    except (OSError, RuntimeError, ValueError) as error:
        raise BadInput(f"path {user_files.format_path(path)}: {getattr(error, 'strerror', None) or error}") from None
    if not inside:
        raise BadInput(f"path {user_files.format_path(path)} leaves {root}")
    return path
