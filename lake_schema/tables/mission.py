"""Declaration of the table `mission`: all parameters of telescope, cameras and survey in the mission database.

A flag marks the values that a run used.
"""

from __future__ import annotations

from lake_schema.columns import Column, Table

STATUSES = (
    ("REQ", "as required"),
    ("DES", "as designed"),
    ("BLT", "as built"),
    ("CBE", "current best estimate"),
    ("SIM", "as simulated"),
)
# Statuses of a parameter's values in the default order of preference: current best estimate, built, designed, required,
# simulated. A value with a later status is used only if there is none with an earlier one.
LADDER = ("CBE", "BLT", "DES", "REQ", "SIM")
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
        Column(
            "value",
            "float64",
            "",
            "instr.param",
            "value, in the unit of the column `unit`; null for a model that is a file",
            nullable=True,
        ),
        Column("unit", "string", ucd="meta.unit", doc="unit of the value, empty for a pure number"),
        Column("status", "string", ucd="meta.code.status", doc="status of the record", codes=STATUSES),
        Column("version", "int32", ucd="meta.version", doc="version of the record", lo=1),
        Column("valid_from", "float64", "d", "time.start", "MJD (UTC) from which it holds", 0.0, 2e5, True),
        Column("confidence", "string", ucd="meta.code.qual", doc="origin of the value", codes=CONFIDENCES),
        Column("source", "string", ucd="meta.ref", doc="source of the value"),
        Column("chosen", "bool", ucd="meta.code", doc="true if the run used this value"),
        Column("overridden", "bool", ucd="meta.code", doc="true if the request replaced the value of the database"),
        Column("file", "string", ucd="meta.ref", doc="file of a model, as the package names it", nullable=True),
        Column(
            "sha256",
            "string",
            ucd="meta.checksum",
            doc="sha256 of that file, and its name in the folder models/ of this version",
            nullable=True,
        ),
    ),
    "Parameters of the telescopes, the cameras and the survey: SELECT name, value, unit, status FROM mission.",
    key=("name", "status", "version", "valid_from", "overridden"),
)
