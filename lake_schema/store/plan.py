"""Plans: descriptions of versions of tables that are to be made.

A plan consists of the declaration of a table, the facts that determine its contents (settings, inputs, code), and one
task per partition (file). A hash of the plan is the key of the version, which names its folder in the lake.
"""

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
    """One partition (Parquet file) of a table, and the facts that determine its contents.

    Attributes
    ----------
    name : str
        Path of the file below dataset/: a file name, or for a catalogue the HATS path of a HEALPix cell, such as
        Norder=5/Dir=0/Npix=17.parquet.
    facts : mapping
        Names and JSON values of the inputs from which the partition is made. They are part of the version's key.
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
        JSON values of everything that determines the contents: seed, settings of the user's request, keys of the
        versions of other tables that are read, numbers of the telescope, fingerprint of the code.
    tasks : tuple of Task
        One task per partition (file). A catalogue must have at least one; other tables may have none.

    Raises
    ------
    BadInput
        If two tasks have the same name, or a catalogue has no task.
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
        """Key of the version, which names its folder: 16 hexadecimal digits.

        They are the first digits of a sha256 of the declaration, the facts and the tasks, so equal plans have equal
        keys.
        """
        table = self.table
        schema = [[f.name, str(f.type), f.nullable, _text(f.metadata)] for f in table.arrow_schema()]
        tasks = [[task.name, dict(task.facts), task.rows] for task in self.tasks]
        declaration = {"table": table.name, "version": table.version, "schema": schema, "key": table.key}
        return digest({**declaration, "facts": dict(self.facts), "parts": tasks})[:16]


@dataclass(frozen=True, slots=True)
class Output:
    """Result of a task function, which computes one partition (file) of a table.

    Attributes
    ----------
    rows : pyarrow.Table
        Rows of the partition.
    files : mapping of str to callable
        Further files, such as images: functions that write the file to a given path. The keys are the paths of the
        files relative to the folder of the version.
    """

    rows: pa.Table
    files: Mapping[str, Callable[[Path], None]] = field(default_factory=dict)


TaskFunction = Callable[[Path, Json], Output]


def data_path(table: Table, partition: str) -> str:
    """Return the path of a partition's Parquet file, relative to the folder of a version of the table."""
    return f"{table.name}/dataset/{partition}" if table.is_catalogue else f"dataset/{partition}"


def _text(metadata: Mapping[bytes, bytes] | None) -> dict[str, str]:
    return {k.decode(): v.decode() for k, v in sorted((metadata or {}).items())}
