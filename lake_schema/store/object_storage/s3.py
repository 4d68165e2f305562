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
CONNECT, ANSWER, TRIES = 5, 60, 3
_BUCKET = re.compile(r"[a-z0-9][a-z0-9._-]{1,253}[a-z0-9]", re.ASCII)
_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}", re.ASCII)
_KEY = re.compile(r"[0-9a-f]{16}", re.ASCII)
_ENDPOINT = re.compile(r"https?://[^/?#@\s]+/?", re.ASCII)
_WORDS = {"endpoint_override": "endpoint", "region": "region"}
# In an address: who asks, and a word with its value.
_USER, _VALUE = re.compile(r"(//)[^/@\s]*@"), re.compile(r"(?<=[?&])([^=&#]*)=[^&#]*")
# Bytes of an object that are fetched at a time.
_PIECE = 8 << 20
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
        told = {word: own for word, name in _WORDS.items() if (own := getattr(self, name))}
        return f"{self.plain}?{urlencode(told, safe=':/')}" if told else self.plain

    @property
    def plain(self) -> str:
        return f"s3://{self.bucket}/{self.prefix}".rstrip("/")

    @property
    def service(self) -> str:
        """URL of the service where the call or the environment names one, else ""."""
        told = self.endpoint or os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""
        if told and not _ENDPOINT.fullmatch(told):
            raise BadInput(f"endpoint {without_secrets(told)}: wanted http://HOST:PORT or https://HOST")
        return told.rstrip("/")

    def key(self, *parts: str) -> str:
        """Name of an object of the lake in its bucket."""
        return "/".join(part for part in (self.prefix, *parts) if part)


def is_address(text: object) -> bool:
    """Whether this names a place on object storage."""
    return str(text).lower().startswith("s3:")


def without_secrets(text: str) -> str:
    """An address as a message may show it: not what stands before an @, nor values that are no endpoint or region."""
    shown = _USER.sub(r"\1..@", text)
    return _VALUE.sub(lambda found: found[0] if found[1] in _WORDS else f"{found[1]}=..", shown)[:200]


def address(text: str, endpoint: str | None = None) -> Address:
    """The place that s3://BUCKET/PREFIX names.

    endpoint : URL of the service, in place of what the text or the environment says
    Errors   : BadInput
    """
    told = urlsplit(text)
    words = dict(parse_qsl(told.query))
    if told.fragment or not text.lower().startswith("s3://") or words.keys() - _WORDS.keys():
        wanted = "s3://BUCKET/PREFIX, maybe with ?endpoint_override=URL&region=REGION"
        raise BadInput(f"lake {without_secrets(text)}: wanted {wanted}")
    if "@" in told.netloc:
        raise BadInput(
            f"lake {without_secrets(text)}: credentials do not stand in an address; the environment has them"
        )
    if not _BUCKET.fullmatch(told.netloc):
        raise BadInput(f"lake {without_secrets(text)}: {told.netloc[:80]!r} is no name of a bucket")
    prefix = told.path.strip("/")
    if not prefix.isprintable() or ({"", ".", ".."} & set(prefix.split("/")) and prefix):
        raise BadInput(f"lake {without_secrets(text)}: the prefix has an empty part, . or ..")
    found = Address(told.netloc, prefix, endpoint or words.get("endpoint_override", ""), words.get("region", ""))
    # Said before anything is asked of it.
    assert found.service is not None
    return found


# ------------------------------------------------------------------------------------------------ what is published


@dataclass(frozen=True, slots=True)
class Published:
    """Keys of the versions that readers see.

    tables : table -> key of its current version;  names : request -> table -> key of its version
    """

    tables: Mapping[str, str]
    names: Mapping[str, Mapping[str, str]]

    def written(self) -> bytes:
        """As the object holds it; equal ones have equal bytes."""
        names = {name: dict(own) for name, own in self.names.items()}
        return json.dumps({"tables": dict(self.tables), "names": names}, sort_keys=True, indent=1).encode()

    def links(self) -> dict[str, str]:
        """The links that a folder would have, and where they lead."""
        found = {f"{table}/{CURRENT}": f"v-{key}" for table, key in self.tables.items()}
        for name, own in self.names.items():
            found |= {f"{_NAMES}/{name}/{table}": f"../../{table}/v-{key}" for table, key in own.items()}
        return found


def published(data: bytes, where: str) -> Published:
    """What the object `current` says.  Errors: Damaged where it is of another form"""
    try:
        told = json.loads(data)
        found = Published(dict(told["tables"]), {name: dict(own) for name, own in told["names"].items()})
        keys = [*found.tables.items(), *(pair for own in found.names.values() for pair in own.items())]
        sound = all(_NAME.fullmatch(name) and _KEY.fullmatch(key) for name, key in keys)
        sound = sound and all(map(_NAME.fullmatch, found.names))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        sound = False
    if not sound:
        raise Damaged(f"{where} does not say which versions are published")
    return found


# ------------------------------------------------------------------------------------------------ how it is read


class Store:
    """The objects of one lake, through pyarrow: `current` is read once, manifests are kept, copies go with this."""

    def __init__(self, place: Address) -> None:
        self.address = place
        self.kept: dict[str, bytes] = {}
        # Of versions, whether they are there.
        self.there: dict[str, bool] = {}

    @cached_property
    def files(self) -> Any:
        from pyarrow import fs

        told: dict[str, Any] = {"endpoint_override": self.address.service} if self.address.service else {}
        if self.address.region:
            told["region"] = self.address.region
        tries = fs.AwsStandardS3RetryStrategy(max_attempts=TRIES)
        return fs.S3FileSystem(connect_timeout=CONNECT, request_timeout=ANSWER, retry_strategy=tries, **told)

    @cached_property
    def links(self) -> dict[str, str]:
        """Errors: BadInput where there is no such lake, or nobody answers."""
        name = f"{self.address.plain}/{CURRENT}"
        try:
            return published(self.data(CURRENT), name).links()
        except FileNotFoundError:
            raise BadInput(
                f"lake {self.address}: there is no object {name}: no lake was pushed there, or the bucket is another"
            ) from None
        except OSError as error:
            self._refused(error)

    @cached_property
    def tables(self) -> dict[str, str]:
        """Key of every version that is published -> its table."""
        return {target.rpartition("v-")[2]: _table(link) for link, target in self.links.items()}

    def _refused(self, error: OSError) -> NoReturn:
        text = str(error)
        if "NETWORK_CONNECTION" in text or "curlCode" in text:
            service = self.address.service or "Amazon S3"
            raise BadInput(f"lake {self.address}: {service} does not answer: {text}") from None
        # Credentials come from the environment, a profile, or the machine's own role.
        raise BadInput(f"lake {self.address} cannot be read: {text}") from None

    @cached_property
    def copies(self) -> tempfile.TemporaryDirectory[str]:
        return tempfile.TemporaryDirectory(prefix="truesky-objects-")

    def path(self, *parts: str) -> str:
        """As pyarrow names an object."""
        return f"{self.address.bucket}/{self.address.key(*parts)}"

    def open(self, *parts: str) -> Any:
        """An object, to be read at any place.  Errors: FileNotFoundError, OSError"""
        return self.files.open_input_file(self.path(*parts))

    def data(self, *parts: str) -> bytes:
        """All bytes of a small object.  Errors: FileNotFoundError, OSError"""
        with self.open(*parts) as stream:
            found: bytes = stream.read()
            return found


def _table(link: str) -> str:
    """Of a link, the table whose version it leads to."""
    *above, table, last = link.split("/")
    return table if last == CURRENT and not above else last


@dataclass(frozen=True)
class Place:
    """A lake (no parts) or a name in it: a link, a folder of links, an object.

    What a folder of links holds, and where they lead, is what `current` said when the lake was first read.
    """

    store: Store = field(repr=False, compare=False)
    parts: tuple[str, ...] = ()

    def __str__(self) -> str:
        """A lake by its whole address, which opens it again."""
        return "/".join([self.store.address.plain, *self.parts]) if self.parts else str(self.store.address)

    def __truediv__(self, name: str) -> Place:
        return Place(self.store, (*self.parts, *PurePosixPath(name).parts))

    @property
    def name(self) -> str:
        return self.parts[-1] if self.parts else ""

    @property
    def parent(self) -> Place:
        return Place(self.store, self.parts[:-1])

    @property
    def relative(self) -> str:
        return "/".join(self.parts)

    def opened_anew(self) -> Place:
        """The same lake as it is now."""
        return Place(Store(self.store.address), self.parts)

    def exists(self) -> bool:
        """Whether there is such an object; for a version's folder whether its manifest is."""
        version = self.name.removeprefix("v-")
        if version == self.name:
            return bool(self._about().type.name == "File")
        if (table := self.store.tables.get(version)) is not None and table != self.parent.name:
            # Keys of versions name their tables, too: that of another is not asked for.
            return False
        if version not in self.store.there:
            # One that was replaced since; what is removed by hand is missed when it is read.
            self.store.there[version] = table is not None or (self / MANIFEST).exists()
        return self.store.there[version]

    def stat(self) -> SimpleNamespace:
        """Bytes of an object and when it was put there, as st_size and st_mtime.  Errors: FileNotFoundError, OSError"""
        about = self._about()
        if about.type.name != "File":
            raise FileNotFoundError(f"{self} is missing")
        return SimpleNamespace(st_size=about.size, st_mtime=about.mtime.timestamp())

    def _about(self) -> Any:
        return self.store.files.get_file_info(self.store.path(*self.parts))

    def glob(self, pattern: str) -> Iterator[Place]:
        """Names right below this one.  Errors: OSError"""
        from pyarrow import fs

        found = self.store.files.get_file_info(fs.FileSelector(self.store.path(*self.parts), allow_not_found=True))
        names = sorted(one.base_name for one in found)
        return (self / name for name in names if fnmatch.fnmatchcase(name, pattern))

    def readlink(self) -> str:
        """Errors: FileNotFoundError where there is no such link."""
        if (target := self.store.links.get(self.relative)) is None:
            raise FileNotFoundError(f"{self} is missing")
        return target

    def iterdir(self) -> Iterator[Place]:
        """Of a folder of links those in it, and folders of such."""
        before = len(self.parts)
        inside = {tuple(link.split("/"))[: before + 1] for link in self._links()}
        return (Place(self.store, parts) for parts in sorted(inside))

    def is_dir(self) -> bool:
        """Whether it is a folder of links."""
        return any(self._links())

    def _links(self) -> Iterator[str]:
        start = f"{self.relative}/" if self.parts else ""
        return (link for link in self.store.links if link.startswith(start))

    def read_bytes(self) -> bytes:
        """All bytes of a small object that never changes; they are kept.  Errors: FileNotFoundError, OSError"""
        if self.relative not in self.store.kept:
            self.store.kept[self.relative] = self.store.data(*self.parts)
        return self.store.kept[self.relative]

    def open(self, mode: str = "rb") -> Any:
        """An object, open for reading.  Errors: FileNotFoundError, OSError"""
        return self.store.open(*self.parts)

    def sizes(self) -> dict[str, int]:
        """Of every object below this name its name from here on, and its bytes.  Errors: OSError"""
        from pyarrow import fs

        start = self.store.path(*self.parts) + "/"
        asked = fs.FileSelector(start.rstrip("/"), recursive=True, allow_not_found=True)
        found = self.store.files.get_file_info(asked)
        return {one.path.removeprefix(start): one.size for one in found if one.type == fs.FileType.File}

    def gathered(self, copies: Iterable[Path]) -> Path:
        """A folder in which copies lie side by side, which lasts as long as they do."""
        target = Path(self.store.copies.name).joinpath(*self.parts)
        target.mkdir(parents=True, exist_ok=True)
        for copy in copies:
            if not (target / copy.name).exists():
                os.link(copy, target / copy.name)
        return target

    def copy(self, sha256: str) -> Path:
        """A file with the object's bytes, which lasts as long as the lake is open.

        sha256 : of the whole object, hexadecimal
        Errors : Damaged where it is of another, or missing
        """
        import hashlib

        target = Path(self.store.copies.name) / sha256 / self.name
        if target.exists():
            return target
        target.parent.mkdir(exist_ok=True)
        summed = hashlib.sha256()
        with tempfile.NamedTemporaryFile(dir=target.parent, delete=False) as written:
            try:
                with self.open() as stream:
                    while piece := stream.read(_PIECE):
                        summed.update(piece)
                        written.write(piece)
            except FileNotFoundError:
                raise Damaged(f"{self} is missing") from None
            except OSError as error:
                raise Damaged(f"{self} cannot be read: {error}") from None
        if summed.hexdigest() != sha256:
            os.unlink(written.name)
            raise Damaged(f"{self} has other contents than the manifest says")
        os.replace(written.name, target)
        return target


# A lake, or a name in it, for who only reads; and the same for what gives a name below the one that it is given.
Folder: TypeAlias = Path | Place
Below = TypeVar("Below", Path, Place, Path | Place)
