"""What the page asks of tables: which there are, rows of a query."""

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
# Integers that a number of JavaScript holds.
_MAX_SAFE_INTEGER = 1 << 53
Json = dict[str, Any]


def describe_lake(lake: LakeSession) -> Json:
    """The tables and their columns, with unit, UCD, bounds and sentence."""
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
    """Whether its rows have positions on the sky."""
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
    """The first rows of a query, with units; `more` says that there are others.

    question : sql
    """
    text = request_body.get("sql")
    if not isinstance(text, str):
        raise BadInput("sql: wanted a text")
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
    """A value as JSON can hold it without loss: integers beyond 2^53 as text, NaN and infinities as text."""
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
    """JSON."""
    return web.Response(text=json.dumps(content, allow_nan=False), content_type="application/json")


def pack(header: Json, *arrays: Array) -> bytes:
    """4 bytes: length of the head, which is JSON; the head; the arrays as they are, little-endian."""
    header_bytes = json.dumps(header).encode()
    # What follows begins at a multiple of four bytes.
    header_bytes += b" " * (-len(header_bytes) % 4)
    return b"".join([struct.pack("<I", len(header_bytes)), header_bytes, *(array.tobytes() for array in arrays)])
