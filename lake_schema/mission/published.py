"""Convert a mission configuration to the table `mission` of a lake, and back.

A configuration consists of the numbers and model files (tables of layouts, curves ...) of telescope, cameras and
survey. The files are stored with the table.
"""

from __future__ import annotations

import math
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import pyarrow as pa

from lake_schema.errors import Damaged
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.model import Model, read_models
from lake_schema.mission.parameter import Parameter, read_all_parameters
from lake_schema.store import manifest
from lake_schema.store.plan import Output
from lake_schema.store.read import Version
from lake_schema.tables.mission import MISSION

# Folder, in a version of the table `mission`, with copies of all model files, named by their sha256. With them, images
# can be rendered again after the files of the package have changed.
_FOLDER = "models"


def to_output(configuration: MissionConfiguration) -> Output:
    """Return the rows of the table `mission` for a mission configuration, and functions that write its model files.

    A mission configuration is the set of chosen numbers and model files (tables) of telescope, cameras and survey.
    """
    contents = {m.sha256: configuration.content(m) for m in configuration.models}
    return Output(
        to_table(configuration),
        {f"{_FOLDER}/{sha256}": partial(_write, data) for sha256, data in contents.items()},
    )


def _write(data: bytes, path: Path) -> None:
    path.write_bytes(data)


def to_table(configuration: MissionConfiguration) -> pa.Table:
    """Return the rows of the table `mission` for a mission configuration (the chosen numbers of telescope and cameras).

    There is one row per record of the mission database, with the column `chosen` True if the configuration contains the
    record. Values that the settings of a simulation have replaced have additional rows, with `overridden` True.
    """
    records: list[Parameter | Model] = [*configuration.parameters, *configuration.models]
    overridden = [record for record in records if record.key in configuration.overridden]
    package_records: list[Parameter | Model] = [*read_all_parameters(), *read_models()]
    # Add records that the installed package does not contain: the configuration may come from an older version, or
    # contain a camera that a user has described.
    listed = {*package_records, *overridden}
    removed_records = [record for record in records if record not in listed]
    all_records = [*package_records, *removed_records, *overridden]
    chosen_records = set(records)
    dates = [math.nan if record.valid_from is None else record.valid_from for record in all_records]
    values = [record.value if isinstance(record, Parameter) else math.nan for record in all_records]
    return MISSION.build(
        {
            "name": [record.key for record in all_records],
            "value": np.ma.masked_invalid(values),
            "unit": [record.unit if isinstance(record, Parameter) else "" for record in all_records],
            "status": [record.status for record in all_records],
            "version": np.array([record.version for record in all_records], np.int64),
            "valid_from": np.ma.masked_invalid(dates),
            "confidence": [record.confidence for record in all_records],
            "source": [record.source for record in all_records],
            "chosen": np.array([record in chosen_records for record in all_records], bool),
            "overridden": np.arange(len(all_records)) >= len(all_records) - len(overridden),
            "file": [record.file if isinstance(record, Model) else None for record in all_records],
            "sha256": [record.sha256 if isinstance(record, Model) else None for record in all_records],
        }
    )


def read_back(version: Version) -> MissionConfiguration:
    """Return the mission configuration (numbers and model files) that a published version of `mission` contains.

    Raises
    ------
    Damaged
        If a file differs from the manifest of the version, or the configuration does not have the recorded sha256.
    """
    try:
        files = [version.folder / f"dataset/{part}" for part in version.partitions]
        states = [manifest.file_state(path) for path in files if isinstance(path, Path)]
    except OSError:
        # Ignore the error of a missing file: reading the version below raises Damaged with a suitable message.
        return _read_configuration(version)
    # Cache the configuration only if all files are on disc; `states` then shows whether they have changed.
    return _read_cached(version, *states) if len(states) == len(files) else _read_configuration(version)


@lru_cache(maxsize=8)
def _read_cached(version: Version, *states: tuple[int, ...]) -> MissionConfiguration:
    """Read the mission configuration of a version, or return it from the cache if its files have not changed.

    `states` are the results of `file_state` for the files of the version; with other states, they are read again.
    """
    return _read_configuration(version)


def _read_configuration(version: Version) -> MissionConfiguration:
    parameters: list[Parameter] = []
    models: list[Model] = []
    overridden = []
    for row in version.rows().to_pylist():
        if not row["chosen"]:
            continue
        provenance = (row["version"], row["valid_from"], row["confidence"], row["source"])
        if row["file"] is None:
            parameters.append(Parameter(row["name"], row["status"], row["value"], row["unit"], *provenance))
        else:
            models.append(Model(row["name"], row["status"], row["file"], row["sha256"], *provenance))
        if row["overridden"]:
            overridden.append(row["name"])
    facts = version.manifest["facts"]
    configuration = MissionConfiguration(
        tuple(sorted(parameters, key=lambda p: p.key)),
        tuple(facts["ladder"]),
        tuple(sorted(overridden)),
        tuple(sorted(models, key=lambda m: m.key)),
        version.sidecar_folder(_FOLDER),
    )
    if configuration.fingerprint != facts["mission"]:
        raise Damaged(f"table mission: version {version.key} is not the configuration {facts['mission']}")
    return configuration
