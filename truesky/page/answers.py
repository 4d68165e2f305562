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
from truesky.page.opened import Lake

ROWS_SHOWN, BYTES_SHOWN = 500, 8 << 20
# Integers that a number of JavaScript holds.
_SAFE = 1 << 53
Json = dict[str, Any]


def described(lake: Lake) -> Json:
    """The tables and their columns, with unit, UCD, bounds and sentence."""
    tables = [
        {
            "name": name,
            "rows": version.num_rows,
            "bytes": sum(entry["bytes"] for entry in version.manifest["files"]),
            "version": version.key,
            "meaning": (version.schema.metadata or {}).get(b"description", b"").decode(),
            "is_catalogue": is_catalogue(version),
            "columns": [_column(field) for field in version.schema],
        }
        for name, version in lake.listed.items()
    ]
    return {
        "key": lake.key,
        "lake": str(lake.root),
        "request": lake.request,
        "version": __version__,
        "tables": tables,
        "damaged": {name: str(error) for name, error in lake.explorer.damaged.items() if lake.explorer.is_listed(name)},
        "limits": {"rows_shown": ROWS_SHOWN, "seconds": lake.timeout},
    }


def is_catalogue(version: read.Version) -> bool:
    """Whether its rows have positions on the sky."""
    return "_healpix_29" in version.schema.names


def _column(field: pa.Field) -> Json:
    facts = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
    about = {"name": field.name, "type": str(field.type), "unit": facts.get("unit", ""), "ucd": facts.get("ucd", "")}
    about |= {"meaning": facts.get("description", ""), "codes": facts.get("codes", "")}
    return about | {key: facts.get(key, "") for key in ("min", "max")}


async def sql(lake: Lake, question: Json) -> Json:
    """The first rows of a query, with units; `more` says that there are others.

    question : sql
    """
    text = question.get("sql")
    if not isinstance(text, str):
        raise BadInput("sql: wanted a text")
    started = time.monotonic()

    async with lake.questions.process() as process:

        def ask() -> pa.Table:
            batches = process.batches(text, {}, lake.timeout, ROWS_SHOWN + 1, BYTES_SHOWN)
            return pa.Table.from_batches(list(batches))

        rows = await asyncio.to_thread(ask)
    shown = rows.slice(0, ROWS_SHOWN)
    told = [votables.values(column, name) for name, column in zip(shown.column_names, shown.columns, strict=True)]
    return {
        "columns": [_column(field) for field in shown.schema],
        "rows": [[plain(value) for value in row] for row in zip(*told, strict=True)],
        "more": rows.num_rows > ROWS_SHOWN,
        "seconds": time.monotonic() - started,
    }


def plain(value: object) -> Any:
    """A value as JSON can hold it without loss: integers beyond 2^53 as text, NaN and infinities as text."""
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return value
    if isinstance(value, int):
        return value if -_SAFE <= value <= _SAFE else str(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    return str(value)


def answer(found: object) -> web.Response:
    """JSON."""
    return web.Response(text=json.dumps(found, allow_nan=False), content_type="application/json")


def packed(head: Json, *arrays: Array) -> bytes:
    """4 bytes: length of the head, which is JSON; the head; the arrays as they are, little-endian."""
    text = json.dumps(head).encode()
    # What follows begins at a multiple of four bytes.
    text += b" " * (-len(text) % 4)
    return b"".join([struct.pack("<I", len(text)), text, *(array.tobytes() for array in arrays)])
