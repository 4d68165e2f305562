"""A lake on object storage, as `truesky push` leaves it there, to be read like a folder.

s3://BUCKET/PREFIX/<table>/v-<key>/...      objects of the same names as the files of a lake
s3://BUCKET/PREFIX/current                  which versions are published: what the links of a folder say, in one object

Whoever opens a lake reads `current` once: all that is read afterwards is of the versions that it named then.

Address     bucket, prefix and endpoint of s3://BUCKET/PREFIX?endpoint_override=URL
Published   what the object `current` says
Place       a lake or a name in it, with those of pathlib's methods that readers call
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
# s until a connection stands, until an answer comes; how often either is tried.
CONNECT_TIMEOUT, REQUEST_TIMEOUT, MAX_ATTEMPTS = 5, 60, 3
_BUCKET = re.compile(r"[a-z0-9][a-z0-9._-]{1,253}[a-z0-9]", re.ASCII)
_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}", re.ASCII)
_KEY = re.compile(r"[0-9a-f]{16}", re.ASCII)
_ENDPOINT = re.compile(r"https?://[^/?#@\s]+/?", re.ASCII)
_QUERY_KEYS = {"endpoint_override": "endpoint", "region": "region"}
# In an address: who asks, and a word with its value.
_USER, _VALUE = re.compile(r"(//)[^/@\s]*@"), re.compile(r"(?<=[?&])([^=&#]*)=[^&#]*")
# Bytes of an object that are fetched at a time.
_CHUNK_BYTES = 8 << 20
_NAMES = "names"


@dataclass(frozen=True, slots=True)
class Address:
    """Where a lake lies.

    endpoint : URL of the service, "" = $AWS_ENDPOINT_URL, else Amazon's;  region : "" = as the environment says
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
        return f"s3://{self.bucket}/{self.prefix}".rstrip("/")

    @property
    def service(self) -> str:
        """URL of the service where the call or the environment names one, else ""."""
        url = self.endpoint or os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""
        if url and not _ENDPOINT.fullmatch(url):
            raise BadInput(f"endpoint {remove_secrets(url)}: wanted http://HOST:PORT or https://HOST")
        return url.rstrip("/")

    def key(self, *parts: str) -> str:
        """Name of an object of the lake in its bucket."""
        return "/".join(part for part in (self.prefix, *parts) if part)


def is_address(text: object) -> bool:
    """Whether this names a place on object storage."""
    return str(text).lower().startswith("s3:")


def remove_secrets(text: str) -> str:
    """An address as a message may show it: not what stands before an @, nor values that are no endpoint or region."""
    masked = _USER.sub(r"\1..@", text)
    return _VALUE.sub(lambda found: found[0] if found[1] in _QUERY_KEYS else f"{found[1]}=..", masked)[:200]


def parse_address(text: str, endpoint: str | None = None) -> Address:
    """The place that s3://BUCKET/PREFIX names.

    endpoint : URL of the service, in place of what the text or the environment says
    Errors   : BadInput
    """
    url = urlsplit(text)
    query = dict(parse_qsl(url.query))
    if url.fragment or not text.lower().startswith("s3://") or query.keys() - _QUERY_KEYS.keys():
        expected = "s3://BUCKET/PREFIX, maybe with ?endpoint_override=URL&region=REGION"
        raise BadInput(f"lake {remove_secrets(text)}: wanted {expected}")
    if "@" in url.netloc:
        raise BadInput(f"lake {remove_secrets(text)}: credentials do not stand in an address; the environment has them")
    if not _BUCKET.fullmatch(url.netloc):
        raise BadInput(f"lake {remove_secrets(text)}: {url.netloc[:80]!r} is no name of a bucket")
    prefix = url.path.strip("/")
    if not prefix.isprintable() or ({"", ".", ".."} & set(prefix.split("/")) and prefix):
        raise BadInput(f"lake {remove_secrets(text)}: the prefix has an empty part, . or ..")
    parsed = Address(url.netloc, prefix, endpoint or query.get("endpoint_override", ""), query.get("region", ""))
    # Said before anything is asked of it.
    assert parsed.service is not None
    return parsed


# ------------------------------------------------------------------------------------------------ what is published


@dataclass(frozen=True, slots=True)
class PublishedVersions:
    """Keys of the versions that readers see.

    tables : table -> key of its current version;  names : request -> table -> key of its version
    """

    tables: Mapping[str, str]
    names: Mapping[str, Mapping[str, str]]

    def to_bytes(self) -> bytes:
        """As the object holds it; equal ones have equal bytes."""
        names = {name: dict(keys_by_table) for name, keys_by_table in self.names.items()}
        return json.dumps({"tables": dict(self.tables), "names": names}, sort_keys=True, indent=1).encode()

    def links(self) -> dict[str, str]:
        """The links that a folder would have, and where they lead."""
        links = {f"{table}/{CURRENT}": f"v-{key}" for table, key in self.tables.items()}
        for name, keys_by_table in self.names.items():
            links |= {f"{_NAMES}/{name}/{table}": f"../../{table}/v-{key}" for table, key in keys_by_table.items()}
        return links


def parse_published(data: bytes, location: str) -> PublishedVersions:
    """What the object `current` says.  Errors: Damaged where it is of another form"""
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
    """The objects of one lake, through pyarrow: `current` is read once, manifests are kept, copies go with this."""

    def __init__(self, address: Address) -> None:
        self.address = address
        self.small_objects: dict[str, bytes] = {}
        # Of versions, whether they are there.
        self.version_exists: dict[str, bool] = {}

    @cached_property
    def files(self) -> Any:
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
        """Errors: BadInput where there is no such lake, or nobody answers."""
        name = f"{self.address.plain}/{CURRENT}"
        try:
            return parse_published(self.read_object(CURRENT), name).links()
        except FileNotFoundError:
            raise BadInput(
                f"lake {self.address}: there is no object {name}: no lake was pushed there, or the bucket is another"
            ) from None
        except OSError as error:
            self._raise_unreadable(error)

    @cached_property
    def tables(self) -> dict[str, str]:
        """Key of every version that is published -> its table."""
        return {target.rpartition("v-")[2]: _table_of_link(link) for link, target in self.links.items()}

    def _raise_unreadable(self, error: OSError) -> NoReturn:
        text = str(error)
        if "NETWORK_CONNECTION" in text or "curlCode" in text:
            service = self.address.service or "Amazon S3"
            raise BadInput(f"lake {self.address}: {service} does not answer: {text}") from None
        # Credentials come from the environment, a profile, or the machine's own role.
        raise BadInput(f"lake {self.address} cannot be read: {text}") from None

    @cached_property
    def copies(self) -> tempfile.TemporaryDirectory[str]:
        return tempfile.TemporaryDirectory(prefix="truesky-objects-")

    def object_path(self, *parts: str) -> str:
        """As pyarrow names an object."""
        return f"{self.address.bucket}/{self.address.key(*parts)}"

    def open(self, *parts: str) -> Any:
        """An object, to be read at any place.  Errors: FileNotFoundError, OSError"""
        return self.files.open_input_file(self.object_path(*parts))

    def read_object(self, *parts: str) -> bytes:
        """All bytes of a small object.  Errors: FileNotFoundError, OSError"""
        with self.open(*parts) as stream:
            data: bytes = stream.read()
            return data


def _table_of_link(link: str) -> str:
    """Of a link, the table whose version it leads to."""
    *above, table, last = link.split("/")
    return table if last == CURRENT and not above else last


@dataclass(frozen=True)
class ObjectPath:
    """A lake (no parts) or a name in it: a link, a folder of links, an object.

    What a folder of links holds, and where they lead, is what `current` said when the lake was first read.
    """

    store: ObjectStore = field(repr=False, compare=False)
    parts: tuple[str, ...] = ()

    def __str__(self) -> str:
        """A lake by its whole address, which opens it again."""
        return "/".join([self.store.address.plain, *self.parts]) if self.parts else str(self.store.address)

    def __truediv__(self, name: str) -> ObjectPath:
        return ObjectPath(self.store, (*self.parts, *PurePosixPath(name).parts))

    @property
    def name(self) -> str:
        return self.parts[-1] if self.parts else ""

    @property
    def parent(self) -> ObjectPath:
        return ObjectPath(self.store, self.parts[:-1])

    @property
    def relative(self) -> str:
        return "/".join(self.parts)

    def reopen(self) -> ObjectPath:
        """The same lake as it is now."""
        return ObjectPath(ObjectStore(self.store.address), self.parts)

    def exists(self) -> bool:
        """Whether there is such an object; for a version's folder whether its manifest is."""
        version = self.name.removeprefix("v-")
        if version == self.name:
            return bool(self._file_info().type.name == "File")
        if (table := self.store.tables.get(version)) is not None and table != self.parent.name:
            # Keys of versions name their tables, too: that of another is not asked for.
            return False
        if version not in self.store.version_exists:
            # One that was replaced since; what is removed by hand is missed when it is read.
            self.store.version_exists[version] = table is not None or (self / MANIFEST).exists()
        return self.store.version_exists[version]

    def stat(self) -> SimpleNamespace:
        """Bytes of an object and when it was put there, as st_size and st_mtime.  Errors: FileNotFoundError, OSError"""
        info = self._file_info()
        if info.type.name != "File":
            raise FileNotFoundError(f"{self} is missing")
        return SimpleNamespace(st_size=info.size, st_mtime=info.mtime.timestamp())

    def _file_info(self) -> Any:
        return self.store.files.get_file_info(self.store.object_path(*self.parts))

    def glob(self, pattern: str) -> Iterator[ObjectPath]:
        """Names right below this one.  Errors: OSError"""
        from pyarrow import fs

        infos = self.store.files.get_file_info(
            fs.FileSelector(self.store.object_path(*self.parts), allow_not_found=True)
        )
        names = sorted(info.base_name for info in infos)
        return (self / name for name in names if fnmatch.fnmatchcase(name, pattern))

    def readlink(self) -> str:
        """Errors: FileNotFoundError where there is no such link."""
        if (target := self.store.links.get(self.relative)) is None:
            raise FileNotFoundError(f"{self} is missing")
        return target

    def iterdir(self) -> Iterator[ObjectPath]:
        """Of a folder of links those in it, and folders of such."""
        depth = len(self.parts)
        inside = {tuple(link.split("/"))[: depth + 1] for link in self._links()}
        return (ObjectPath(self.store, parts) for parts in sorted(inside))

    def is_dir(self) -> bool:
        """Whether it is a folder of links."""
        return any(self._links())

    def _links(self) -> Iterator[str]:
        start = f"{self.relative}/" if self.parts else ""
        return (link for link in self.store.links if link.startswith(start))

    def read_bytes(self) -> bytes:
        """All bytes of a small object that never changes; they are kept.  Errors: FileNotFoundError, OSError"""
        if self.relative not in self.store.small_objects:
            self.store.small_objects[self.relative] = self.store.read_object(*self.parts)
        return self.store.small_objects[self.relative]

    def open(self, mode: str = "rb") -> Any:
        """An object, open for reading.  Errors: FileNotFoundError, OSError"""
        return self.store.open(*self.parts)

    def sizes(self) -> dict[str, int]:
        """Of every object below this name its name from here on, and its bytes.  Errors: OSError"""
        from pyarrow import fs

        start = self.store.object_path(*self.parts) + "/"
        selector = fs.FileSelector(start.rstrip("/"), recursive=True, allow_not_found=True)
        infos = self.store.files.get_file_info(selector)
        return {info.path.removeprefix(start): info.size for info in infos if info.type == fs.FileType.File}

    def gather_copies(self, copies: Iterable[Path]) -> Path:
        """A folder in which copies lie side by side, which lasts as long as they do."""
        target = Path(self.store.copies.name).joinpath(*self.parts)
        target.mkdir(parents=True, exist_ok=True)
        for copy in copies:
            if not (target / copy.name).exists():
                os.link(copy, target / copy.name)
        return target

    def download(self, sha256: str) -> Path:
        """A file with the object's bytes, which lasts as long as the lake is open.

        sha256 : of the whole object, hexadecimal
        Errors : Damaged where it is of another, or missing
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


# A lake, or a name in it, for who only reads; and the same for what gives a name below the one that it is given.
Folder: TypeAlias = Path | ObjectPath
Below = TypeVar("Below", Path, ObjectPath, Path | ObjectPath)
