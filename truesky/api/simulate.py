"""Check and run requests (definitions of simulations, as TOML files or dictionaries) from Python."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lake_schema import arguments, instruction_set, user_files
from lake_schema.arrays import as_python
from lake_schema.errors import BadInput
from lake_schema.store import layout
from truesky.api.lake import Lake
from truesky.commands import check as check_command
from truesky.commands import run as run_command
from truesky.commands import space, submit
from truesky.request import accuracy, universe
from truesky.request.from_toml import ValidParts, from_table, parse, parse_valid_parts, read_valid_parts
from truesky.request.schema import Request
from truesky.running import submitted_job

if TYPE_CHECKING:
    # Imported where it is used, because the import takes 0.4 s.
    import pandas as pd

_MAX_DETECTORS = 2**63 - 1


@arguments.refuse_missing('truesky.check("request.toml")')
def check(request: str | Path | Mapping[str, Any]) -> Request:
    """Check a request for a simulation as completely as the jobs do, without writing anything.

    Parameters
    ----------
    request : str, Path or mapping
        Path of a TOML file, or a dictionary with the same keys. The numbers of a dictionary may be numpy numbers, and
        its lists may be tuples or arrays. Relative file names in a dictionary start at the current folder.

    Returns
    -------
    Request
        The request with all defaults filled in.

    Raises
    ------
    BadInput
        If a job would refuse the request. The message names the key and the allowed values. The attribute ``messages``
        of the error has one line for each mistake.

    Examples
    --------
    >>> import truesky
    >>> area = {"cone": {"ra": 53.1, "dec": -27.8, "radius": 0.1}}
    >>> truesky.check({"name": "field", "seed": 1, "area": area, "fluxes": {"bands": ["euclid_vis"]}}).seed
    1
    """
    parts = _parse_valid_parts(request)
    try:
        return check_command.checked_request(parts)[0]
    except BadInput as error:
        raise error.with_prefix(_describe_request(request)) from None


@arguments.refuse_missing('truesky.run("request.toml", "lake")')
def run(
    request: str | Path | Mapping[str, Any],
    lake: str | Path,
    detectors: str | Sequence[str] = (),
    limit: int | None = None,
    lenses: bool = False,
    gaia: bool = False,
) -> Lake:
    """Run all jobs of a request: compute its catalogues, fluxes, plan of exposures and images.

    The jobs share one Spark session: the active one of this process, else a local session. Tables and images that the
    lake already has are not computed again, so a second call continues where an interrupted one ended.

    Parameters
    ----------
    request : str, Path or mapping
        Path of a TOML file, or a dictionary with the same keys, see `check`.
    lake : str or Path
        Folder of the lake, in which all results are stored. It is created if it does not exist.
    detectors : str or sequence of str, optional
        Names of the detectors to render. The default is all planned detectors.
    limit : int, optional
        Largest number of detector images to render, at least 1. The default is all.
    lenses : bool, optional
        Also compute the table of strong lenses.
    gaia : bool, optional
        Also compute the table `gaia`: the simulated stars as Gaia DR2 would list them.

    Returns
    -------
    Lake
        The lake, opened for this request.

    Raises
    ------
    BadInput
        If the request is wrong, the lake was filled with other settings of the simulated universe, or the disc has too
        little space. Nothing is computed in these cases.
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
        raise error.with_prefix(_describe_request(request)) from None
    space.check(root, parsed_request, plan)
    if not submitted_job.has_session():
        submit.use_environment()
    for stage in stages:
        submitted_job.run(import_module(stage.module).JOB, root, stage.request(parsed_request))
    return Lake(root, request=parsed_request.name)


def accuracies() -> pd.DataFrame:
    """List the errors and the CPU time of drawing sources for each named setting of accuracy.

    The name of such a setting is the value of the key ``accuracy`` of a request.

    Returns
    -------
    pandas.DataFrame
        One row per name, such as ``survey``. Four columns are the largest allowed errors: ``flux`` (relative),
        ``shape`` (reduced shear), ``position`` (pixels), and ``background`` (in units of the noise of a sky pixel).
        Four columns with the suffix ``_reached`` are the measured errors. ``seconds`` is the CPU time to draw all
        sources of a VIS detector. The other columns are parameters of the drawing code.
    """
    import pandas as pd

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


def _parse_valid_parts(request: str | Path | Mapping[str, Any]) -> ValidParts:
    if isinstance(request, Mapping):
        return read_valid_parts(_to_toml_value(request))
    return parse_valid_parts(user_files.expand_path(request))


def _to_toml_value(value: Any) -> Any:
    """Convert numpy numbers, tuples and arrays in a value of a dictionary to the types that a TOML file would give."""
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
