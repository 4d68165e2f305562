"""Open catalogues on object storage for programs that use fsspec, such as lsdb; objects are read with pyarrow.

Files read in this way are not compared with the manifest. Use `truesky verify --deep s3://sky/lake` for this.

Examples
--------
Search a cone with lsdb::

    lsdb.open_catalog(catalogue("s3://sky/lake", "galaxies")).cone_search(53.1, -27.8, 60.0).compute()
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
    """Buckets of an object store as a file system for fsspec; truesky://BUCKET/NAME is an object.

    Parameters
    ----------
    endpoint, region : str
        Endpoint and region of the store, see s3.Address.
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
        """Return the bytes of an object.

        Parameters
        ----------
        path : str
            Path of the object.
        start, end : int, optional
            Range of bytes; negative values count from the end, which pyarrow's files do not support.
        **_
            Ignored.

        Returns
        -------
        bytes
            Content in this range.
        """
        with self.fs.open_input_file(self._strip_protocol(path)) as stream:
            first, last, _step = slice(start, end).indices(stream.size())
            content: bytes = stream.read_at(max(last - first, 0), first)
            return content


def catalogue(lake: str, table: str, request: str | None = None) -> UPath:
    """Return the current version of a catalogue on object storage, for lsdb and hats.

    Parameters
    ----------
    lake : str
        s3://BUCKET/PREFIX, optionally with ?endpoint_override=URL.
    table : str
        Name of the table.
    request : str, optional
        Name of the request, if the lake contains several.

    Returns
    -------
    UPath
        Path of the catalogue.

    Raises
    ------
    BadInput
        If `lake` is not an address on object storage, or the table is not a catalogue.
    """
    root = layout.open_lake(lake)
    if not isinstance(root, s3.ObjectPath):
        raise BadInput(f"lake {lake} is not an address s3://..: lsdb opens a folder by its path")
    version, place = read.version(root, table, request=request), root.store.address
    if not version.has_file("collection.properties"):
        raise BadInput(f"table {table} is not a catalogue: version {version.key} has no HATS collection")
    fsspec.register_implementation(_PROTOCOL, Objects, clobber=True)
    name = root.store.object_path(table, f"v-{version.key}")
    with warnings.catch_warnings():
        # UPath warns that it does not know this protocol.
        warnings.simplefilter("ignore")
        return UPath(f"{_PROTOCOL}://{name}", endpoint=place.endpoint, region=place.region)
