"""Answers to the page about tables: list of tables and columns, first rows of a query."""

from __future__ import annotations

import asyncio
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

MAX_ROWS, MAX_BYTES = 500, 8 << 20
# Integers up to this value are exact in JavaScript.
_MAX_SAFE_INTEGER = 1 << 53
Json = dict[str, Any]


def describe_lake(lake: LakeSession) -> Json:
    """Return a description of the lake: its tables, and their columns with unit, UCD, limits and meaning."""
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
    """Return True if the rows of a table have positions on the sky."""
    return "_healpix_29" in version.schema.names


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
    """Run a query and return its first rows with units.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    request_body : dict
        The query, under key `sql`.

    Returns
    -------
    dict
        `columns`, `rows` (at most MAX_ROWS), `more` (True if the result has more rows) and `seconds` (wall time).

    Raises
    ------
    BadInput
        If `sql` is not a string, or the query is refused.
    """
    text = request_body.get("sql")
    if not isinstance(text, str):
        raise BadInput("sql must be a string")
    started = time.monotonic()

    async with lake.user_queries.process() as process:

        def fetch_rows() -> pa.Table:
            batches = process.batches(text, {}, lake.timeout, MAX_ROWS + 1, MAX_BYTES)
            return pa.Table.from_batches(list(batches))

        rows = await asyncio.to_thread(fetch_rows)
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
    """Convert a value to JSON without loss: integers beyond 2^53, NaN and infinities become strings."""
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
    """Return a JSON response."""
    return web.Response(text=json.dumps(content, allow_nan=False), content_type="application/json")


def pack(header: Json, *arrays: Array) -> bytes:
    """Pack a JSON header and arrays into bytes.

    Parameters
    ----------
    header : dict
        The header.
    *arrays : array
        Arrays of a little-endian type.

    Returns
    -------
    bytes
        The length of the header (4 bytes, little-endian), the header as JSON, then the bytes of the arrays.
    """
    header_bytes = json.dumps(header).encode()
    # JavaScript requires that the arrays start at a multiple of four bytes.
    header_bytes += b" " * (-len(header_bytes) % 4)
    return b"".join([struct.pack("<I", len(header_bytes)), header_bytes, *(array.tobytes() for array in arrays)])
