"""Read a lake (a folder of versioned tables) on object storage, where `truesky push` has written it, like a folder.

The objects of a lake are::

    s3://BUCKET/PREFIX/<table>/v-<key>/...      files of a version of a table, with the same names as on disc
    s3://BUCKET/PREFIX/current                  list of published versions, which replaces the links of a lake on disc

`current` is read once, at the first access to a lake. All later reads refer to the versions that it listed then.
"""

from __future__ import annotations

import contextlib
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

from lake_schema import user_files
from lake_schema.errors import BadInput, Damaged

# Name of the link to the version of a table that was published last; on object storage, name of the list of versions.
CURRENT = "current"
# Name of the file in the folder of a version that lists its files.
MANIFEST = "manifest.json"
# Time limit for opening a connection, in s.
CONNECT_TIMEOUT = 5
# Time limit for an answer of the service, in s.
REQUEST_TIMEOUT = 60
# Largest number of attempts for each operation.
MAX_ATTEMPTS = 3
_BUCKET = re.compile(r"[a-z0-9][a-z0-9._-]{1,253}[a-z0-9]", re.ASCII)
_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}", re.ASCII)
_KEY = re.compile(r"[0-9a-f]{16}", re.ASCII)
_ENDPOINT = re.compile(r"https?://[^/?#@\s]+/?", re.ASCII)
_QUERY_KEYS = {"endpoint_override": "endpoint", "region": "region"}
# Pattern of the user name and password in an address, "//USER:PASSWORD@".
_USER = re.compile(r"(//)[^/@\s]*@")
# Pattern of a parameter of an address with its value, "NAME=VALUE" after "?" or "&".
_VALUE = re.compile(r"(?<=[?&])([^=&#]*)=[^&#]*")
# Number of bytes of an object that are read at a time.
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
        Beginning of the names of the lake's objects, without a slash at its end; "" for the whole bucket.
    endpoint : str
        URL of the service. If it is "", the environment variables $AWS_ENDPOINT_URL_S3 and $AWS_ENDPOINT_URL are used,
        else Amazon S3.
    region : str
        Name of the region, or "" for the region that is configured in the environment.
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
        """The address as a text without endpoint and region: s3://BUCKET/PREFIX."""
        return f"s3://{self.bucket}/{self.prefix}".rstrip("/")

    @property
    def service(self) -> str:
        """URL of the service: `endpoint`, else the value of an environment variable, else "" for Amazon S3.

        BadInput is raised if it is not of the form http://HOST:PORT or https://HOST.
        """
        url = self.endpoint or os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""
        if url and not _ENDPOINT.fullmatch(url):
            raise BadInput(f"endpoint {remove_secrets(url)}: must be http://HOST:PORT or https://HOST")
        return url.rstrip("/")

    def key(self, *parts: str) -> str:
        """Return the full name of an object in the bucket: the prefix and `parts`, joined by slashes."""
        return "/".join(part for part in (self.prefix, *parts) if part)


def is_address(text: object) -> bool:
    """Return True if a text begins with "s3:" in any case; whether it is a valid address is not checked."""
    return str(text).lower().startswith("s3:")


def remove_secrets(text: str) -> str:
    """Return an address for an error message, in which secrets are replaced by "..".

    Secrets are the user name, the password, and the values of all parameters except endpoint and region. The result is
    cut after 200 characters.
    """
    masked = _USER.sub(r"\1..@", text)
    return _VALUE.sub(lambda found: found[0] if found[1] in _QUERY_KEYS else f"{found[1]}=..", masked)[:200]


def parse_address(text: str, endpoint: str | None = None, place: str = "lake") -> Address:
    """Parse an address s3://BUCKET/PREFIX?endpoint_override=URL&region=REGION, in which the parameters are optional.

    Parameters
    ----------
    text : str
        The address.
    endpoint : str, optional
        URL of the service. It takes precedence over the URL in the address and in the environment.
    place : str, optional
        Word for the address in messages.

    Returns
    -------
    Address
        Bucket, prefix, endpoint and region.

    Raises
    ------
    BadInput
        If the text has another form, contains a password or another parameter, or the endpoint is not a valid URL.
    """
    url = urlsplit(text)
    query = dict(parse_qsl(url.query))
    if url.fragment or not text.lower().startswith("s3://") or query.keys() - _QUERY_KEYS.keys():
        expected = "s3://BUCKET/PREFIX, optionally with ?endpoint_override=URL&region=REGION"
        example = f"; did you mean s3://{remove_secrets(text)}?" if re.fullmatch(r"[\w.-]+(/[\w.-]+)*/?", text) else ""
        raise BadInput(f"{place} {remove_secrets(text)}: must be {expected}{example}")
    if "@" in url.netloc:
        raise BadInput(f"{place} {remove_secrets(text)}: credentials must not be in an address but in the environment")
    if not _BUCKET.fullmatch(url.netloc):
        raise BadInput(f"{place} {remove_secrets(text)}: {url.netloc[:80]!r} is not a valid name of a bucket")
    prefix = url.path.strip("/")
    if not prefix.isprintable() or ({"", ".", ".."} & set(prefix.split("/")) and prefix):
        raise BadInput(f"{place} {remove_secrets(text)}: the prefix has an empty part, . or ..")
    parsed = Address(url.netloc, prefix, endpoint or query.get("endpoint_override", ""), query.get("region", ""))
    # Get the URL of the service only to check it now: the property raises BadInput if it is not valid.
    assert parsed.service is not None
    return parsed


# ------------------------------------- list of the published versions


@dataclass(frozen=True, slots=True)
class PublishedVersions:
    """List of the published versions of a lake's tables, which the object `current` contains.

    Attributes
    ----------
    tables : mapping of str to str
        Key (16 hexadecimal digits) of the version of each table that was published last, by name of the table.
    names : mapping of str to mapping of str to str
        For each request (named set of settings): the keys of its versions of tables, by name of the table.
    """

    tables: Mapping[str, str]
    names: Mapping[str, Mapping[str, str]]

    def to_bytes(self) -> bytes:
        """Return this list of versions as JSON, the contents of the object `current`; equal lists give equal bytes."""
        names = {name: dict(keys_by_table) for name, keys_by_table in self.names.items()}
        return json.dumps({"tables": dict(self.tables), "names": names}, sort_keys=True, indent=1).encode()

    def links(self) -> dict[str, str]:
        """Return the paths of the symbolic links that a lake on disc would have, and their targets."""
        links = {f"{table}/{CURRENT}": f"v-{key}" for table, key in self.tables.items()}
        for name, keys_by_table in self.names.items():
            links |= {f"{_NAMES}/{name}/{table}": f"../../{table}/v-{key}" for table, key in keys_by_table.items()}
        return links


def parse_published(data: bytes, location: str) -> PublishedVersions:
    """Parse the contents of the object `current`, the JSON list of the published versions of a lake.

    `location` is the address of the object for the error message.

    Raises
    ------
    Damaged
        If `data` is not such a list, or contains a name or key that is not valid.
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


# ------------------------------------- reading objects


class ObjectStore:
    """Objects of one lake on object storage, read through pyarrow.

    The list of versions (object `current`) is read once, small objects are cached in memory, and temporary copies of
    larger objects are removed together with this instance.
    """

    def __init__(self, address: Address) -> None:
        self.address = address
        self.small_objects: dict[str, bytes] = {}
        # Cache by path of a version's folder, relative to the lake: True if the version exists.
        self.version_exists: dict[str, bool] = {}

    @cached_property
    def files(self) -> Any:
        """pyarrow.fs.S3FileSystem for the service and region of the address."""
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
        """Paths of the symbolic links that the lake would have on disc, and their targets, from the object `current`.

        BadInput is raised if there is no lake at the address or the service does not answer, Damaged if the object is
        not a valid list of versions.
        """
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
        """Name of the table of each published version, by key of the version."""
        return {target.rpartition("v-")[2]: _table_of_link(link) for link, target in self.links.items()}

    def _raise_unreadable(self, error: OSError) -> NoReturn:
        text = str(error)
        if "NETWORK_CONNECTION" in text or "curlCode" in text:
            service = self.address.service or "Amazon S3"
            raise BadInput(f"lake {self.address}: {service} does not answer: {text}") from None
        # A frequent reason is wrong credentials, which pyarrow reads from the environment, a profile of AWS, or the
        # role of the machine.
        raise BadInput(f"lake {self.address} cannot be read: {text}") from None

    @cached_property
    def copies(self) -> tempfile.TemporaryDirectory[str]:
        """Temporary folder for copies of objects, created at the first use and removed with this instance."""
        return tempfile.TemporaryDirectory(prefix="truesky-objects-")

    def object_path(self, *parts: str) -> str:
        """Return the path of an object in the form that pyarrow requires: BUCKET/PREFIX/parts."""
        return f"{self.address.bucket}/{self.address.key(*parts)}"

    def open(self, *parts: str) -> Any:
        """Open an object for reading at any offset; raise FileNotFoundError or another OSError on failure."""
        return self.files.open_input_file(self.object_path(*parts))

    def read_object(self, *parts: str) -> bytes:
        """Return all bytes of an object; raise FileNotFoundError or another OSError if it cannot be read.

        Damaged is raised if the object is larger than the limit of a manifest.
        """
        with self.open(*parts) as stream:
            if stream.size() > (limit := user_files.MAX_BYTES["manifest"]):
                raise Damaged(f"{self.address.plain}/{'/'.join(parts)} is larger than {limit} bytes")
            data: bytes = stream.read()
            return data


def _table_of_link(link: str) -> str:
    """Return the name of the table to which a link belongs.

    `link` is <table>/current, the last version of a table, or names/<request>/<table>, the version of a request.
    """
    *above, table, last = link.split("/")
    return table if last == CURRENT and not above else last


@dataclass(frozen=True)
class ObjectPath:
    """Path in a lake on object storage, with those methods of pathlib.Path that readers of a lake use.

    The path is the lake itself if `parts` is empty, else an object (file), or a symbolic link or folder of links that
    the lake would have on disc. The links come from the object `current`, which is read once per `store`.
    """

    store: ObjectStore = field(repr=False, compare=False)
    parts: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Return the address of an object, or for the lake itself its full address with endpoint and region."""
        return "/".join([self.store.address.plain, *self.parts]) if self.parts else str(self.store.address)

    def __truediv__(self, name: str) -> ObjectPath:
        return ObjectPath(self.store, (*self.parts, *PurePosixPath(name).parts))

    @property
    def name(self) -> str:
        """Last part of the path, "" for the lake itself."""
        return self.parts[-1] if self.parts else ""

    @property
    def parent(self) -> ObjectPath:
        """Path without its last part; the parent of the lake is the lake itself."""
        return ObjectPath(self.store, self.parts[:-1])

    @property
    def relative(self) -> str:
        """Path relative to the lake, with slashes; "" for the lake itself."""
        return "/".join(self.parts)

    def reopen(self) -> ObjectPath:
        """Return the same path with a new store, which reads the list of published versions (`current`) again."""
        return ObjectPath(ObjectStore(self.store.address), self.parts)

    def exists(self) -> bool:
        """Return True if an object of this name exists, or for a folder v-<key> if the version is published.

        The folder of a version that is not published also exists if its manifest does.
        """
        version = self.name.removeprefix("v-")
        if version == self.name:
            return bool(self._file_info().type.name == "File")
        if (table := self.store.tables.get(version)) is not None and table != self.parent.name:
            # The key belongs to one table only, so the version cannot exist in the folder of another table.
            return False
        if self.relative not in self.store.version_exists:
            # Assume without a query that a published version exists; if it has been removed, reading fails later. A
            # version that is not published may exist, so look for its manifest.
            self.store.version_exists[self.relative] = table is not None or (self / MANIFEST).exists()
        return self.store.version_exists[self.relative]

    def stat(self) -> SimpleNamespace:
        """Return an object's size in bytes as `st_size`, and its time of modification as `st_mtime` (s since 1970).

        FileNotFoundError is raised if the object does not exist, another OSError if the service does not answer.
        """
        info = self._file_info()
        if info.type.name != "File":
            raise FileNotFoundError(f"{self} is missing")
        return SimpleNamespace(st_size=info.size, st_mtime=info.mtime.timestamp())

    def _file_info(self) -> Any:
        return self.store.files.get_file_info(self.store.object_path(*self.parts))

    def glob(self, pattern: str) -> Iterator[ObjectPath]:
        """Return the sorted paths of objects and folders directly below this path whose names match a shell pattern.

        The result is empty if nothing exists there; OSError is raised if the service does not answer.
        """
        from pyarrow import fs

        infos = self.store.files.get_file_info(
            fs.FileSelector(self.store.object_path(*self.parts), allow_not_found=True)
        )
        names = sorted(info.base_name for info in infos)
        return (self / name for name in names if fnmatch.fnmatchcase(name, pattern))

    def readlink(self) -> str:
        """Return the target that this link would have on disc; raise FileNotFoundError if there is no such link."""
        if (target := self.store.links.get(self.relative)) is None:
            raise FileNotFoundError(f"{self} is missing")
        return target

    def iterdir(self) -> Iterator[ObjectPath]:
        """Return the sorted paths of links, and of folders of links, directly below this path; objects are left out."""
        depth = len(self.parts)
        inside = {tuple(link.split("/"))[: depth + 1] for link in self._links()}
        return (ObjectPath(self.store, parts) for parts in sorted(inside))

    def is_dir(self) -> bool:
        """Return True if the lake would have symbolic links below this path on disc."""
        return any(self._links())

    def _links(self) -> Iterator[str]:
        start = f"{self.relative}/" if self.parts else ""
        return (link for link in self.store.links if link.startswith(start))

    def read_bytes(self) -> bytes:
        """Return all bytes of a small object and cache them in memory; the object must never change.

        FileNotFoundError or another OSError is raised if it cannot be read.
        """
        if self.relative not in self.store.small_objects:
            self.store.small_objects[self.relative] = self.store.read_object(*self.parts)
        return self.store.small_objects[self.relative]

    def open(self, mode: str = "rb") -> Any:
        """Open an object for reading bytes; `mode` is ignored. FileNotFoundError or another OSError may be raised."""
        return self.store.open(*self.parts)

    def sizes(self) -> dict[str, int]:
        """Return the size in bytes of each object below this path, in all subfolders, by relative path.

        The result is empty without objects; OSError is raised if the service does not answer.
        """
        from pyarrow import fs

        start = self.store.object_path(*self.parts) + "/"
        selector = fs.FileSelector(start.rstrip("/"), recursive=True, allow_not_found=True)
        infos = self.store.files.get_file_info(selector)
        return {info.path.removeprefix(start): info.size for info in infos if info.type == fs.FileType.File}

    def gather_copies(self, copies: Iterable[Path]) -> Path:
        """Return a temporary folder with hard links to copies of objects, under the names of the copies.

        The folder is removed together with `store`, the ObjectStore of this path.
        """
        target = Path(self.store.copies.name).joinpath(*self.parts)
        target.mkdir(parents=True, exist_ok=True)
        for copy in copies:
            # Another thread may have made the link.
            with contextlib.suppress(FileExistsError):
                os.link(copy, target / copy.name)
        return target

    def download(self, sha256: str) -> Path:
        """Copy the object to a temporary file, compare its sha256, and return the path of the file.

        An existing copy is used again. The file is removed together with `store`, the ObjectStore of this path.

        Raises
        ------
        Damaged
            If the object is missing, cannot be read, or has another sha256 than `sha256` (hexadecimal).
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


# Type of a lake or of a path in it: on disc, or on object storage.
Folder: TypeAlias = Path | ObjectPath
# Type variable for functions that return a path of the same type as their argument.
Below = TypeVar("Below", Path, ObjectPath, Path | ObjectPath)
