"""Open catalogues on object storage (such as Amazon S3) for programs that use fsspec, such as lsdb.

Objects are read with pyarrow. Their checksums are not compared with the manifest (the list of a table's files with
their checksums). Use `truesky verify --deep s3://sky/lake` to check them.

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
    """File system for fsspec that reads the buckets of an object store.

    The path of an object is truesky://BUCKET/NAME or BUCKET/NAME.

    Parameters
    ----------
    endpoint, region : str
        URL and region of the object store, as in `s3.Address`; "" for the defaults.
    **_
        Further options of fsspec, ignored.
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
            Path of the object, truesky://BUCKET/NAME or BUCKET/NAME.
        start, end : int, optional
            First byte, and byte after the last one. Negative values count from the end of the object, as in a slice.
            By default the range begins at the beginning and ends at the end of the object.
        **_
            Ignored.

        Returns
        -------
        bytes
            Content in this range; b"" if the range is empty.
        """
        with self.fs.open_input_file(self._strip_protocol(path)) as stream:
            first, last, _step = slice(start, end).indices(stream.size())
            content: bytes = stream.read_at(max(last - first, 0), first)
            return content


def catalogue(lake: str, table: str, request: str | None = None) -> UPath:
    """Return the path of a catalogue on object storage, with which lsdb and hats can open it.

    A table can have several versions; the path is that of the current version.

    Parameters
    ----------
    lake : str
        Address of the lake: s3://BUCKET/PREFIX, optionally with ?endpoint_override=URL.
    table : str
        Name of the table.
    request : str, optional
        Name of the request; required if requests of the lake have different versions of the table.

    Returns
    -------
    UPath
        Path of the catalogue's folder, with the protocol truesky. The functions `read_hats` open a HATS map.

    Raises
    ------
    BadInput
        If `lake` is not an address on object storage, the table does not exist, or it is not stored as a HATS catalogue
        (files sorted by HEALPix cells).
    """
    root = layout.open_lake(lake)
    if not isinstance(root, s3.ObjectPath):
        raise BadInput(f"lake {lake} is not an address s3://..: lsdb opens a folder by its path")
    version, place = read.version(root, table, request=request), root.store.address
    is_collection = version.has_file("collection.properties")
    if not is_collection and not version.has_file(f"{table}/hats.properties"):
        raise BadInput(f"table {table} is not a catalogue: version {version.key} has no HATS files")
    fsspec.register_implementation(_PROTOCOL, Objects, clobber=True)
    name = root.store.object_path(table, f"v-{version.key}", *(() if is_collection else (table,)))
    with warnings.catch_warnings():
        # UPath would warn that the protocol truesky has no implementation in UPath itself.
        warnings.simplefilter("ignore")
        return UPath(f"{_PROTOCOL}://{name}", endpoint=place.endpoint, region=place.region)
