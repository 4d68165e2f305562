"""Plans of versions: a table, the facts that determine its contents, and its tasks. A plan's hash names the version."""

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
    """One partition (file) of a table, and the facts that the task function needs to make it.

    Attributes
    ----------
    name : str
        Path of the file below dataset/: a plain name, or the HATS path of a catalogue's cell.
    facts : mapping
        JSON values, which are part of the plan's key.
    rows : int or None
        Number of rows that the partition must have, or None if any number is allowed.
    """

    name: str
    facts: Json
    rows: int | None = None


@dataclass(frozen=True, slots=True)
class Plan:
    """A version of a table that is to be made.

    Attributes
    ----------
    table : Table
        Declaration of the table.
    facts : mapping
        JSON values of everything that determines the contents: seed, request, keys of inputs, mission, code version.
    tasks : tuple of Task
        One task per partition.
    """

    table: Table
    facts: Json
    tasks: tuple[Task, ...]

    def __post_init__(self) -> None:
        if len({task.name for task in self.tasks}) != len(self.tasks):
            raise BadInput(f"table {self.table.name}: the plan names a partition twice")
        if self.table.is_catalogue and not self.tasks:
            raise BadInput(f"table {self.table.name}: the plan has no cells")

    @property
    def key(self) -> str:
        """Key of the version: 16 hexadecimal digits of a hash of the declaration, the facts and the tasks."""
        table = self.table
        schema = [[f.name, str(f.type), f.nullable, _text(f.metadata)] for f in table.arrow_schema()]
        tasks = [[task.name, dict(task.facts), task.rows] for task in self.tasks]
        declaration = {"table": table.name, "version": table.version, "schema": schema, "key": table.key}
        return digest({**declaration, "facts": dict(self.facts), "parts": tasks})[:16]


@dataclass(frozen=True, slots=True)
class Output:
    """Result of a task function.

    Attributes
    ----------
    rows : pyarrow.Table
        Rows of the partition.
    files : mapping of str to callable
        Further files: functions that write a file to a path, by relative name.
    """

    rows: pa.Table
    files: Mapping[str, Callable[[Path], None]] = field(default_factory=dict)


TaskFunction = Callable[[Path, Json], Output]


def data_path(table: Table, partition: str) -> str:
    """Return the path of a partition's Parquet file in a version."""
    return f"{table.name}/dataset/{partition}" if table.is_catalogue else f"dataset/{partition}"


def _text(metadata: Mapping[bytes, bytes] | None) -> dict[str, str]:
    return {k.decode(): v.decode() for k, v in sorted((metadata or {}).items())}
