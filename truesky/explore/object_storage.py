"""Catalogues on object storage for programs that read by fsspec, such as lsdb: the objects come through pyarrow.

    lsdb.open_catalog(catalogue("s3://sky/lake", "galaxies")).cone_search(53.1, -27.8, 60.0).compute()

Nothing that is read so is compared with the manifest: `truesky verify --deep s3://sky/lake` is.
"""

from __future__ import annotations

import warnings
from typing import Any

import fsspec
from fsspec.implementations.arrow import ArrowFSWrapper
from upath import UPath

from lake_schema.errors import BadInput
from lake_schema.store import layout, read
from lake_schema.store.object_storage import s3

_PROTOCOL = "truesky"


class Objects(ArrowFSWrapper):  # type: ignore[misc]
    """The buckets of a service, for fsspec; truesky://BUCKET/NAME is an object of it.

    endpoint, region : as of s3.Address
    """

    protocol = _PROTOCOL
    root_marker = ""
    cachable = True

    def __init__(self, endpoint: str = "", region: str = "", **_: Any) -> None:
        super().__init__(s3.ObjectStore(s3.Address("", "", endpoint, region)).files)

    @classmethod
    def _strip_protocol(cls, path: Any) -> Any:
        if isinstance(path, list):
            return [cls._strip_protocol(item) for item in path]
        return str(path).removeprefix(f"{_PROTOCOL}://").rstrip("/")

    @classmethod
    def _parent(cls, path: str) -> str:
        return str(cls._strip_protocol(path)).rpartition("/")[0]

    def cat_file(self, path: str, start: int | None = None, end: int | None = None, **_: Any) -> bytes:
        """Bytes of an object; places below 0 count from its end, which pyarrow's own files do not know."""
        with self.fs.open_input_file(self._strip_protocol(path)) as stream:
            first, last, _step = slice(start, end).indices(stream.size())
            content: bytes = stream.read_at(max(last - first, 0), first)
            return content


def catalogue(lake: str, table: str, request: str | None = None) -> UPath:
    """A catalogue of a lake on object storage as lsdb and hats open it: the version that is published now.

    lake    : s3://BUCKET/PREFIX, maybe with ?endpoint_override=URL;  request : whose, where the lake has several
    Errors  : BadInput for what is no such lake, or no catalogue of it
    """
    root = layout.open_lake(lake)
    if not isinstance(root, s3.ObjectPath):
        raise BadInput(f"lake {lake} is no address s3://..: lsdb opens a folder by its path")
    version, place = read.version(root, table, request=request), root.store.address
    if not version.has_file("collection.properties"):
        raise BadInput(f"table {table} is no catalogue: version {version.key} has no HATS collection")
    fsspec.register_implementation(_PROTOCOL, Objects, clobber=True)
    name = root.store.object_path(table, f"v-{version.key}")
    with warnings.catch_warnings():
        # That UPath does not know this protocol by itself.
        warnings.simplefilter("ignore")
        return UPath(f"{_PROTOCOL}://{name}", endpoint=place.endpoint, region=place.region)
