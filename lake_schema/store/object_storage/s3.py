"""Read a lake on object storage, where `truesky push` has written it, like a folder.

The objects of a lake are::

    s3://BUCKET/PREFIX/<table>/v-<key>/...      objects with the names of the files of a lake
    s3://BUCKET/PREFIX/current                  published versions: the targets of a folder's links, in one object

`current` is read once when a lake is opened; all later reads refer to the versions that it listed at that time.
"""

from __future__ import annotations

import fnmatch
import json
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path, PurePosixPath
from types import SimpleNamespace
from typing import Any, NoReturn, TypeAlias, TypeVar
from urllib.parse import parse_qsl, urlencode, urlsplit

from lake_schema.errors import BadInput, Damaged

CURRENT, MANIFEST = "current", "manifest.json"
# Time limits (s) for a connection and for an answer, and number of attempts.
CONNECT_TIMEOUT, REQUEST_TIMEOUT, MAX_ATTEMPTS = 5, 60, 3
_BUCKET = re.compile(r"[a-z0-9][a-z0-9._-]{1,253}[a-z0-9]", re.ASCII)
_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}", re.ASCII)
_KEY = re.compile(r"[0-9a-f]{16}", re.ASCII)
_ENDPOINT = re.compile(r"https?://[^/?#@\s]+/?", re.ASCII)
_QUERY_KEYS = {"endpoint_override": "endpoint", "region": "region"}
# Patterns of an address: the user with the password, and a parameter with its value.
_USER, _VALUE = re.compile(r"(//)[^/@\s]*@"), re.compile(r"(?<=[?&])([^=&#]*)=[^&#]*")
# Bytes of an object that are read at a time.
_CHUNK_BYTES = 8 << 20
_NAMES = "names"


@dataclass(frozen=True, slots=True)
class Address:
    """Address of a lake on object storage.

    Attributes
    ----------
    bucket : str
        Name of the bucket.
    prefix : str
        Beginning of the names of the lake's objects.
    endpoint : str
        URL of the service, or "" for $AWS_ENDPOINT_URL, else Amazon S3.
    region : str
        Name of the region, or "" for the region of the environment.
    """

    bucket: str
    prefix: str
    endpoint: str = ""
    region: str = ""

    def __str__(self) -> str:
        query = {word: value for word, name in _QUERY_KEYS.items() if (value := getattr(self, name))}
        return f"{self.plain}?{urlencode(query, safe=':/')}" if query else self.plain

    @property
    def plain(self) -> str:
        """The address without endpoint and region."""
        return f"s3://{self.bucket}/{self.prefix}".rstrip("/")

    @property
    def service(self) -> str:
        """URL of the service from the call or from the environment, "" for Amazon S3."""
        url = self.endpoint or os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""
        if url and not _ENDPOINT.fullmatch(url):
            raise BadInput(f"endpoint {remove_secrets(url)}: must be http://HOST:PORT or https://HOST")
        return url.rstrip("/")

    def key(self, *parts: str) -> str:
        """Return the name of an object of the lake in its bucket."""
        return "/".join(part for part in (self.prefix, *parts) if part)


def is_address(text: object) -> bool:
    """Return True if a text is an address of object storage."""
    return str(text).lower().startswith("s3:")


def remove_secrets(text: str) -> str:
    """Return an address for a message, with masked user, password, and parameters except endpoint and region."""
    masked = _USER.sub(r"\1..@", text)
    return _VALUE.sub(lambda found: found[0] if found[1] in _QUERY_KEYS else f"{found[1]}=..", masked)[:200]


def parse_address(text: str, endpoint: str | None = None) -> Address:
    """Parse an address s3://BUCKET/PREFIX with optional parameters.

    Parameters
    ----------
    text : str
        The address.
    endpoint : str, optional
        URL of the service, which replaces the URL of the address or of the environment.

    Returns
    -------
    Address
        The address.

    Raises
    ------
    BadInput
        If the address or the endpoint is wrong.
    """
    url = urlsplit(text)
    query = dict(parse_qsl(url.query))
    if url.fragment or not text.lower().startswith("s3://") or query.keys() - _QUERY_KEYS.keys():
        expected = "s3://BUCKET/PREFIX, optionally with ?endpoint_override=URL&region=REGION"
        raise BadInput(f"lake {remove_secrets(text)}: must be {expected}")
    if "@" in url.netloc:
        raise BadInput(f"lake {remove_secrets(text)}: credentials must not be in an address but in the environment")
    if not _BUCKET.fullmatch(url.netloc):
        raise BadInput(f"lake {remove_secrets(text)}: {url.netloc[:80]!r} is not a valid name of a bucket")
    prefix = url.path.strip("/")
    if not prefix.isprintable() or ({"", ".", ".."} & set(prefix.split("/")) and prefix):
        raise BadInput(f"lake {remove_secrets(text)}: the prefix has an empty part, . or ..")
    parsed = Address(url.netloc, prefix, endpoint or query.get("endpoint_override", ""), query.get("region", ""))
    # This checks the endpoint before the first request.
    assert parsed.service is not None
    return parsed


# ------------------------------------------------------------------------------------------------ what is published


@dataclass(frozen=True, slots=True)
class PublishedVersions:
    """Keys of the published versions.

    Attributes
    ----------
    tables : mapping of str to str
        Key of the current version, by table.
    names : mapping of str to mapping of str to str
        Keys of the versions of a request by table, by name of the request.
    """

    tables: Mapping[str, str]
    names: Mapping[str, Mapping[str, str]]

    def to_bytes(self) -> bytes:
        """Return the contents of the object `current`; equal instances give equal bytes."""
        names = {name: dict(keys_by_table) for name, keys_by_table in self.names.items()}
        return json.dumps({"tables": dict(self.tables), "names": names}, sort_keys=True, indent=1).encode()

    def links(self) -> dict[str, str]:
        """Return the links that a folder would have, and their targets."""
        links = {f"{table}/{CURRENT}": f"v-{key}" for table, key in self.tables.items()}
        for name, keys_by_table in self.names.items():
            links |= {f"{_NAMES}/{name}/{table}": f"../../{table}/v-{key}" for table, key in keys_by_table.items()}
        return links


def parse_published(data: bytes, location: str) -> PublishedVersions:
    """Parse the object `current`; `location` is its name for the message.

    Raises
    ------
    Damaged
        If the object has another form.
    """
    try:
        content = json.loads(data)
        versions = PublishedVersions(
            dict(content["tables"]), {name: dict(keys_by_table) for name, keys_by_table in content["names"].items()}
        )
        keys = [
            *versions.tables.items(),
            *(pair for keys_by_table in versions.names.values() for pair in keys_by_table.items()),
        ]
        is_valid = all(_NAME.fullmatch(name) and _KEY.fullmatch(key) for name, key in keys)
        is_valid = is_valid and all(map(_NAME.fullmatch, versions.names))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        is_valid = False
    if not is_valid:
        raise Damaged(f"{location} does not say which versions are published")
    return versions


# ------------------------------------------------------------------------------------------------ how it is read


class ObjectStore:
    """Objects of one lake, read through pyarrow.

    `current` is read once, small objects are cached, and copies are removed with this instance.
    """

    def __init__(self, address: Address) -> None:
        self.address = address
        self.small_objects: dict[str, bytes] = {}
        # True or False for versions whose existence is known.
        self.version_exists: dict[str, bool] = {}

    @cached_property
    def files(self) -> Any:
        """File system of pyarrow."""
        from pyarrow import fs

        options: dict[str, Any] = {"endpoint_override": self.address.service} if self.address.service else {}
        if self.address.region:
            options["region"] = self.address.region
        tries = fs.AwsStandardS3RetryStrategy(max_attempts=MAX_ATTEMPTS)
        return fs.S3FileSystem(
            connect_timeout=CONNECT_TIMEOUT, request_timeout=REQUEST_TIMEOUT, retry_strategy=tries, **options
        )

    @cached_property
    def links(self) -> dict[str, str]:
        """Links of the lake and their targets; raise BadInput if there is no such lake or service."""
        name = f"{self.address.plain}/{CURRENT}"
        try:
            return parse_published(self.read_object(CURRENT), name).links()
        except FileNotFoundError:
            raise BadInput(
                f"lake {self.address}: there is no object {name}: no lake was pushed there, or the bucket is wrong"
            ) from None
        except OSError as error:
            self._raise_unreadable(error)

    @cached_property
    def tables(self) -> dict[str, str]:
        """Tables of all published versions, by key."""
        return {target.rpartition("v-")[2]: _table_of_link(link) for link, target in self.links.items()}

    def _raise_unreadable(self, error: OSError) -> NoReturn:
        text = str(error)
        if "NETWORK_CONNECTION" in text or "curlCode" in text:
            service = self.address.service or "Amazon S3"
            raise BadInput(f"lake {self.address}: {service} does not answer: {text}") from None
        # Credentials come from the environment, a profile, or the role of the machine.
        raise BadInput(f"lake {self.address} cannot be read: {text}") from None

    @cached_property
    def copies(self) -> tempfile.TemporaryDirectory[str]:
        """Temporary folder for copies of objects."""
        return tempfile.TemporaryDirectory(prefix="truesky-objects-")

    def object_path(self, *parts: str) -> str:
        """Return the path of an object for pyarrow."""
        return f"{self.address.bucket}/{self.address.key(*parts)}"

    def open(self, *parts: str) -> Any:
        """Open an object for reading at any offset; raise FileNotFoundError or OSError on failure."""
        return self.files.open_input_file(self.object_path(*parts))

    def read_object(self, *parts: str) -> bytes:
        """Return the contents of a small object; raise FileNotFoundError or OSError if that fails."""
        with self.open(*parts) as stream:
            data: bytes = stream.read()
            return data


def _table_of_link(link: str) -> str:
    """Return the table of the version to which a link leads."""
    *above, table, last = link.split("/")
    return table if last == CURRENT and not above else last


@dataclass(frozen=True)
class ObjectPath:
    """A lake on object storage (no parts), or a name in it: a link, a folder of links, or an object.

    It has the methods of pathlib.Path that readers use. Links and their targets come from `current` at the time of
    the first read.
    """

    store: ObjectStore = field(repr=False, compare=False)
    parts: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Return the full address of a lake, with which it can be opened again, or the address of an object."""
        return "/".join([self.store.address.plain, *self.parts]) if self.parts else str(self.store.address)

    def __truediv__(self, name: str) -> ObjectPath:
        return ObjectPath(self.store, (*self.parts, *PurePosixPath(name).parts))

    @property
    def name(self) -> str:
        """Last part of the path, "" for a lake."""
        return self.parts[-1] if self.parts else ""

    @property
    def parent(self) -> ObjectPath:
        """Path without its last part."""
        return ObjectPath(self.store, self.parts[:-1])

    @property
    def relative(self) -> str:
        """Path from the root of the lake."""
        return "/".join(self.parts)

    def reopen(self) -> ObjectPath:
        """Return the same path with a store that reads `current` again."""
        return ObjectPath(ObjectStore(self.store.address), self.parts)

    def exists(self) -> bool:
        """Return True if the object exists. A version's folder exists if its manifest exists."""
        version = self.name.removeprefix("v-")
        if version == self.name:
            return bool(self._file_info().type.name == "File")
        if (table := self.store.tables.get(version)) is not None and table != self.parent.name:
            # The key determines the table, so no request is needed for another table.
            return False
        if version not in self.store.version_exists:
            # Unpublished versions may still exist. If a published one was removed by hand, reading it fails.
            self.store.version_exists[version] = table is not None or (self / MANIFEST).exists()
        return self.store.version_exists[version]

    def stat(self) -> SimpleNamespace:
        """Return size (bytes) and time of an object as st_size and st_mtime; raise OSError if that fails."""
        info = self._file_info()
        if info.type.name != "File":
            raise FileNotFoundError(f"{self} is missing")
        return SimpleNamespace(st_size=info.size, st_mtime=info.mtime.timestamp())

    def _file_info(self) -> Any:
        return self.store.files.get_file_info(self.store.object_path(*self.parts))

    def glob(self, pattern: str) -> Iterator[ObjectPath]:
        """Return the matching names directly below this one; raise OSError if that fails."""
        from pyarrow import fs

        infos = self.store.files.get_file_info(
            fs.FileSelector(self.store.object_path(*self.parts), allow_not_found=True)
        )
        names = sorted(info.base_name for info in infos)
        return (self / name for name in names if fnmatch.fnmatchcase(name, pattern))

    def readlink(self) -> str:
        """Return the target of a link; raise FileNotFoundError if there is no such link."""
        if (target := self.store.links.get(self.relative)) is None:
            raise FileNotFoundError(f"{self} is missing")
        return target

    def iterdir(self) -> Iterator[ObjectPath]:
        """Return the links and the folders of links in this folder of links."""
        depth = len(self.parts)
        inside = {tuple(link.split("/"))[: depth + 1] for link in self._links()}
        return (ObjectPath(self.store, parts) for parts in sorted(inside))

    def is_dir(self) -> bool:
        """Return True if this is a folder of links."""
        return any(self._links())

    def _links(self) -> Iterator[str]:
        start = f"{self.relative}/" if self.parts else ""
        return (link for link in self.store.links if link.startswith(start))

    def read_bytes(self) -> bytes:
        """Return the contents of a small object that never changes, and cache them; raise OSError if that fails."""
        if self.relative not in self.store.small_objects:
            self.store.small_objects[self.relative] = self.store.read_object(*self.parts)
        return self.store.small_objects[self.relative]

    def open(self, mode: str = "rb") -> Any:
        """Open an object for reading; raise FileNotFoundError or OSError if that fails."""
        return self.store.open(*self.parts)

    def sizes(self) -> dict[str, int]:
        """Return the size in bytes of each object below this name, by relative name; raise OSError if that fails."""
        from pyarrow import fs

        start = self.store.object_path(*self.parts) + "/"
        selector = fs.FileSelector(start.rstrip("/"), recursive=True, allow_not_found=True)
        infos = self.store.files.get_file_info(selector)
        return {info.path.removeprefix(start): info.size for info in infos if info.type == fs.FileType.File}

    def gather_copies(self, copies: Iterable[Path]) -> Path:
        """Return a folder with links to copies of objects, which exists as long as the copies."""
        target = Path(self.store.copies.name).joinpath(*self.parts)
        target.mkdir(parents=True, exist_ok=True)
        for copy in copies:
            if not (target / copy.name).exists():
                os.link(copy, target / copy.name)
        return target

    def download(self, sha256: str) -> Path:
        """Return a file with a copy of the object, which exists as long as the lake is open.

        Raises
        ------
        Damaged
            If the object is missing or its sha256 differs from `sha256` (hexadecimal).
        """
        import hashlib

        target = Path(self.store.copies.name) / sha256 / self.name
        if target.exists():
            return target
        target.parent.mkdir(exist_ok=True)
        file_hash = hashlib.sha256()
        with tempfile.NamedTemporaryFile(dir=target.parent, delete=False) as temporary:
            try:
                with self.open() as stream:
                    while piece := stream.read(_CHUNK_BYTES):
                        file_hash.update(piece)
                        temporary.write(piece)
            except FileNotFoundError:
                raise Damaged(f"{self} is missing") from None
            except OSError as error:
                raise Damaged(f"{self} cannot be read: {error}") from None
        if file_hash.hexdigest() != sha256:
            os.unlink(temporary.name)
            raise Damaged(f"{self} has other contents than the manifest says")
        os.replace(temporary.name, target)
        return target


# A lake or a path in it, for readers; and a type variable for functions that return a path of the same type.
Folder: TypeAlias = Path | ObjectPath
Below = TypeVar("Below", Path, ObjectPath, Path | ObjectPath)
