"""Answers to the web page about tables: their names and columns, and the first rows of an SQL query."""

from __future__ import annotations

import json
import math
import struct
import time
from typing import Any

import pyarrow as pa
from aiohttp import web

from lake_schema import __version__
from lake_schema.arrays import Array
from lake_schema.errors import BadInput
from lake_schema.store import read
from truesky.explore import votables
from truesky.page.lake_session import LakeSession

# Largest number of rows that are shown of a query's result.
MAX_ROWS = 500
# Largest size in bytes of the rows that are shown of a query's result.
MAX_BYTES = 8 << 20
# JavaScript has no separate integers; integers up to this absolute value are exact.
_MAX_SAFE_INTEGER = 1 << 53
Json = dict[str, Any]


def describe_lake(lake: LakeSession) -> Json:
    """Return a description of the lake for the page.

    Among its keys are `tables` (name, number of rows, bytes, meaning, and columns with unit, UCD, limits and meaning of
    each table), `damaged` (errors of the tables that cannot be opened) and `key` (an identifier that changes if the
    content of a table changes).
    """
    tables = [
        {
            "name": name,
            "rows": version.num_rows,
            "bytes": sum(entry["bytes"] for entry in version.manifest["files"]),
            "version": version.key,
            "meaning": (version.schema.metadata or {}).get(b"description", b"").decode(),
            "is_catalogue": is_catalogue(version),
            "columns": [_describe_column(field) for field in version.schema],
        }
        for name, version in lake.listed_versions.items()
    ]
    return {
        "key": lake.key,
        "lake": str(lake.root),
        "request": lake.request,
        "version": __version__,
        "tables": tables,
        "damaged": {name: str(error) for name, error in lake.explorer.damaged.items() if lake.explorer.is_listed(name)},
        "limits": {"rows_shown": MAX_ROWS, "seconds": lake.timeout},
    }


def is_catalogue(version: read.Version) -> bool:
    """Return True if the rows of a table are sources with positions on the sky and the HEALPix column `_healpix_29`."""
    return {"_healpix_29", "ra", "dec"} <= set(version.schema.names)


def _describe_column(field: pa.Field) -> Json:
    metadata = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
    description = {
        "name": field.name,
        "type": str(field.type),
        "unit": metadata.get("unit", ""),
        "ucd": metadata.get("ucd", ""),
    }
    description |= {"meaning": metadata.get("description", ""), "codes": metadata.get("codes", "")}
    return description | {key: metadata.get(key, "") for key in ("min", "max")}


async def run_query(lake: LakeSession, request_body: Json) -> Json:
    """Run an SQL query of the user, and return the first rows of its result.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    request_body : dict
        Body of the HTTP request; its key `sql` contains the query.

    Returns
    -------
    dict
        `columns` (name, type, unit and meaning of each column), `rows` (at most 500, each a list of values), `more`
        (True if the result has more rows) and `seconds` (wall time of the query).

    Raises
    ------
    BadInput
        If `sql` is not a string, the query is not an allowed SELECT or fails, or 501 rows have more than 8 MiB.
    """
    text = request_body.get("sql")
    if not isinstance(text, str):
        raise BadInput("sql must be a string")
    started = time.monotonic()

    async with lake.user_queries.process() as process:

        def fetch_rows() -> pa.Table:
            batches = process.batches(text, {}, lake.timeout, MAX_ROWS + 1, MAX_BYTES)
            return pa.Table.from_batches(list(batches))

        rows = await lake.user_queries.threads.run(fetch_rows)
    shown_rows = rows.slice(0, MAX_ROWS)
    columns = [
        votables.python_values(column, name)
        for name, column in zip(shown_rows.column_names, shown_rows.columns, strict=True)
    ]
    return {
        "columns": [_describe_column(field) for field in shown_rows.schema],
        "rows": [[to_json_value(value) for value in row] for row in zip(*columns, strict=True)],
        "more": rows.num_rows > MAX_ROWS,
        "seconds": time.monotonic() - started,
    }


def to_json_value(value: object) -> Any:
    """Convert a value to one that JSON can represent without loss.

    Integers beyond 2^53, NaN, infinities, and values of other types such as dates become strings. Lists and
    dictionaries are converted item by item.
    """
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return value
    if isinstance(value, int):
        return value if -_MAX_SAFE_INTEGER <= value <= _MAX_SAFE_INTEGER else str(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, list | tuple):
        return [to_json_value(item) for item in value]
    if isinstance(value, dict):
        return {str(key): to_json_value(item) for key, item in value.items()}
    return str(value)


def json_response(content: object) -> web.Response:
    """Return an HTTP response with the content as JSON; ValueError is raised if it contains NaN or an infinity."""
    return web.Response(text=json.dumps(content, allow_nan=False), content_type="application/json")


def pack(header: Json, *arrays: Array) -> bytes:
    """Pack a JSON header and arrays into bytes, which the JavaScript of the page reads.

    Parameters
    ----------
    header : dict
        Content of the header; it must contain what is needed to read the arrays, such as their shapes.
    *arrays : array
        Arrays of a little-endian type.

    Returns
    -------
    bytes
        The length of the header (4 bytes, little-endian), the header as JSON (padded with spaces to a multiple of four
        bytes), then the bytes of the arrays without gaps.
    """
    header_bytes = json.dumps(header).encode()
    # Typed arrays of JavaScript must start at a multiple of four bytes.
    header_bytes += b" " * (-len(header_bytes) % 4)
    return b"".join([struct.pack("<I", len(header_bytes)), header_bytes, *(array.tobytes() for array in arrays)])
