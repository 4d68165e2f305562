"""Check and run simulation requests from Python."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pandas as pd

from lake_schema import arguments, instruction_set, user_files
from lake_schema.arrays import as_python
from lake_schema.errors import BadInput
from lake_schema.store import layout
from truesky.api.lake import Lake
from truesky.commands import check as check_command
from truesky.commands import run as run_command
from truesky.commands import space, submit
from truesky.request import accuracy, universe
from truesky.request.from_toml import from_table, parse
from truesky.request.schema import Request
from truesky.running import submitted_job

_MAX_DETECTORS = 2**63 - 1


def check(request: str | Path | Mapping[str, Any]) -> Request:
    """Check a request as completely as the jobs do, without writing anything.

    Parameters
    ----------
    request : str, Path or mapping
        A TOML file, or the same keys as a dictionary, whose numbers may be numpy's and whose lists may be tuples or
        arrays. Relative file names in a dictionary start at the current folder.

    Returns
    -------
    Request
        The parsed request.

    Raises
    ------
    BadInput
        If any job would refuse the request. The message names the key and the allowed values.

    Examples
    --------
    >>> import truesky
    >>> area = {"cone": {"ra": 53.1, "dec": -27.8, "radius": 0.1}}
    >>> truesky.check({"name": "field", "seed": 1, "area": area, "fluxes": {"bands": ["euclid_vis"]}}).seed
    1
    """
    parsed = _parse_request(request)
    try:
        check_command.check_request(parsed)
    except BadInput as error:
        raise BadInput(f"{_describe_request(request)}: {error}") from None
    return parsed


def run(
    request: str | Path | Mapping[str, Any],
    lake: str | Path,
    detectors: str | Sequence[str] = (),
    limit: int | None = None,
    lenses: bool = False,
    gaia: bool = False,
) -> Lake:
    """Run all jobs of a request: catalogues, fluxes, the plan of the exposures and images.

    The jobs share one Spark session: the active one of this process, else a local session. Tables that the lake
    already has are kept, so a second call continues where an interrupted one ended.

    Parameters
    ----------
    request : str, Path or mapping
        A TOML file, or the same keys as a dictionary.
    lake : str or Path
        Folder of the lake. It is created if it does not exist.
    detectors : str or sequence of str, optional
        Names of the detectors to render. The default is all planned detectors.
    limit : int, optional
        Largest number of detectors to render.
    lenses : bool, optional
        Also compute the table of strong lenses.
    gaia : bool, optional
        Also compute the stars as Gaia DR2 would list them.

    Returns
    -------
    Lake
        The lake, opened for this request.

    Raises
    ------
    BadInput
        If the request is wrong, the lake belongs to another universe, or the disc has too little room. Nothing is
        computed then.
    LakeError
        If a job fails.
    """
    detector_names = arguments.check_names("detectors", detectors)
    max_detectors = None if limit is None else arguments.check_integer("limit", limit, 1, _MAX_DETECTORS)
    parsed_request = replace(_parse_request(request), detectors=detector_names, limit=max_detectors)
    instruction_set.check()
    root = layout.resolve_lake(lake)
    universe.check_lake(root, parsed_request)
    stages = run_command.stages(parsed_request, lenses, gaia)
    try:
        plan = run_command.checked_plan(root, parsed_request, stages)
    except BadInput as error:
        raise BadInput(f"{_describe_request(request)}: {error}") from None
    space.check(root, parsed_request, plan)
    if not submitted_job.has_session():
        submit.use_environment()
    for stage in stages:
        submitted_job.run(import_module(stage.module).JOB, root, stage.request(parsed_request))
    return Lake(root, request=parsed_request.name)


def accuracies() -> pd.DataFrame:
    """List the allowed errors, the measured errors and the cost of drawing sources for each named accuracy.

    Returns
    -------
    pandas.DataFrame
        One row per name, such as ``survey``. The columns are the largest allowed errors of a source's ``flux``
        (relative), ``shape`` (reduced shear) and ``position`` (pixels), and of the ``background`` (in units of the
        noise of a sky pixel); the measured errors, with the suffix ``_reached``; ``seconds`` of CPU time to draw all
        sources of a VIS detector; and the settings that are used for drawing.
    """
    rows = {}
    for name, allowed in accuracy.PRESETS.items():
        row, errors = accuracy.fastest_row(allowed), asdict(allowed)
        reached = {f"{key}_reached": value for key, value in asdict(accuracy.expected_errors(allowed)).items()}
        settings = {key: value for key, value in row.items() if key.removesuffix("_held") not in errors}
        rows[name] = {**errors, **reached, **settings}
    return pd.DataFrame.from_dict(rows, orient="index")


def _parse_request(request: str | Path | Mapping[str, Any]) -> Request:
    if isinstance(request, Mapping):
        return from_table(_to_toml_value(request))
    return parse(user_files.expand_path(request))


def _to_toml_value(value: Any) -> Any:
    """Convert a value of a dictionary to the type that a TOML file would give."""
    if isinstance(value, Mapping):
        return {key: _to_toml_value(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_to_toml_value(entry) for entry in value]
    try:
        return as_python(value)
    except TypeError:
        return value


def _describe_request(request: str | Path | Mapping[str, Any]) -> str:
    return (
        "request"
        if isinstance(request, Mapping)
        else f"request {user_files.format_path(user_files.expand_path(request))}"
    )
