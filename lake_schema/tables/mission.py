"""Table `mission`: the Mission Database with every record of every parameter, and which of them a run chose."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Protocol

import numpy as np
import pyarrow as pa

from lake_schema.columns import Column, Table

STATUSES = (
    ("REQ", "as required"),
    ("DES", "as designed"),
    ("BLT", "as built"),
    ("CBE", "current best estimate"),
    ("SIM", "as simulated"),
)
CONFIDENCES = (
    ("published", "read in its source"),
    ("quoted", "quoted, the source was not at hand"),
    ("derived", "computed from published values"),
    ("assumed", "chosen here"),
)

MISSION = Table(
    "mission",
    1,
    (
        Column("name", "string", ucd="meta.id", doc="name of the parameter"),
        Column("value", "float64", "", "instr.param", "value, in the unit of the column `unit`"),
        Column("unit", "string", ucd="meta.unit", doc="unit of the value, empty for a pure number"),
        Column("status", "string", ucd="meta.code.status", doc="status of the record", codes=STATUSES),
        Column("version", "int32", ucd="meta.version", doc="version of the record", lo=1),
        Column("valid_from", "float64", "d", "time.start", "MJD (UTC) from which it holds", 0.0, 2e5, True),
        Column("confidence", "string", ucd="meta.code.qual", doc="what the value rests on", codes=CONFIDENCES),
        Column("source", "string", ucd="meta.ref", doc="where the value is from"),
        Column("chosen", "bool", ucd="meta.code", doc="is this the value that the run used?"),
        Column("overridden", "bool", ucd="meta.code", doc="did the request put it in place of the database's?"),
    ),
    "Parameters of the telescopes, the cameras and the survey: SELECT name, value, unit, status FROM mission.",
    key=("name", "status", "version", "valid_from", "overridden"),
)


class Parameter(Protocol):
    """A record of the Mission Database."""

    @property
    def key(self) -> str: ...
    @property
    def status(self) -> str: ...
    @property
    def value(self) -> float: ...
    @property
    def unit(self) -> str: ...
    @property
    def version(self) -> int: ...
    @property
    def valid_from(self) -> float | None: ...
    @property
    def confidence(self) -> str: ...
    @property
    def source(self) -> str: ...


def rows(records: Sequence[Parameter], chosen: Collection[Parameter], overridden: Collection[str] = ()) -> pa.Table:
    """Table `mission`.

    records    : every record of the database;  chosen : one a name (MissionConfiguration.parameters)
    overridden : names whose chosen value a request gave; it stands in a row of its own
    """
    given = [parameter for parameter in chosen if parameter.key in overridden]
    every = [*records, *given]
    valid_from = [parameter.valid_from for parameter in every]
    return MISSION.build(
        {
            "name": [parameter.key for parameter in every],
            "value": np.array([parameter.value for parameter in every], float),
            "unit": [parameter.unit for parameter in every],
            "status": [parameter.status for parameter in every],
            "version": np.array([parameter.version for parameter in every], np.int64),
            "valid_from": np.ma.masked_array(
                [0.0 if date is None else date for date in valid_from], [date is None for date in valid_from]
            ),
            "confidence": [parameter.confidence for parameter in every],
            "source": [parameter.source for parameter in every],
            "chosen": np.array([parameter in chosen for parameter in every], bool),
            "overridden": np.arange(len(every)) >= len(records),
        }
    )
