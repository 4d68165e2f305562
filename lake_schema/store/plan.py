"""What is to be made: a table, everything that goes into it, its parts.  The hash of it all names the version."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa

from lake_schema.columns import Table
from lake_schema.errors import BadInput
from lake_schema.store.provenance import digest

Json = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Task:
    """One file of a table and what its maker needs to know.

    name  : file below dataset/ for a plain table, the HATS path for a catalogue's cell
    facts : JSON values; they go into the plan's key
    rows  : how many rows it must have, None = whatever its maker finds
    """

    name: str
    facts: Json
    rows: int | None = None


@dataclass(frozen=True, slots=True)
class Plan:
    """A version of a table that is to be made.

    facts : JSON values of everything that goes into it (seed, request, inputs' keys, mission, code version)
    """

    table: Table
    facts: Json
    tasks: tuple[Task, ...]

    def __post_init__(self) -> None:
        if len({task.name for task in self.tasks}) != len(self.tasks):
            raise BadInput(f"table {self.table.name}: the plan names a part twice")
        if self.table.is_catalogue and not self.tasks:
            raise BadInput(f"table {self.table.name}: the plan has no cells")

    @property
    def key(self) -> str:
        """16 hexadecimal digits that stand for all of it."""
        table = self.table
        schema = [[f.name, str(f.type), f.nullable, _text(f.metadata)] for f in table.arrow_schema()]
        tasks = [[task.name, dict(task.facts), task.rows] for task in self.tasks]
        declaration = {"table": table.name, "version": table.version, "schema": schema, "key": table.key}
        return digest({**declaration, "facts": dict(self.facts), "parts": tasks})[:16]


@dataclass(frozen=True, slots=True)
class Output:
    """What a part's maker returns: its rows, and files that belong to them (relative name -> writer of a path)."""

    rows: pa.Table
    files: Mapping[str, Callable[[Path], None]] = field(default_factory=dict)


TaskFunction = Callable[[Path, Json], Output]


def data_path(table: Table, partition: str) -> str:
    """Path of a part's Parquet file in a version."""
    return f"{table.name}/dataset/{partition}" if table.is_catalogue else f"dataset/{partition}"


def _text(metadata: Mapping[bytes, bytes] | None) -> dict[str, str]:
    return {k.decode(): v.decode() for k, v in sorted((metadata or {}).items())}
