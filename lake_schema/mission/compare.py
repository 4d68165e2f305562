"""Compare two mission configurations (sets of the numbers of telescope, cameras and survey).

The command is truesky mission diff A B.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lake_schema import user_files
from lake_schema.errors import BadInput
from lake_schema.mission import camera_folder
from lake_schema.mission.configuration import MissionConfiguration, differences, resolve
from lake_schema.mission.parameter import STATUSES
from lake_schema.mission.published import read_back
from lake_schema.store import layout, read
from lake_schema.tables.mission import LADDER


def compare_configurations(first: str, second: str) -> list[str]:
    """Return one line per parameter or model (file) that differs between two mission configurations.

    Parameters
    ----------
    first, second : str
        Order of preference of statuses ("CBE,BLT,DES,REQ,SIM"), path of a request file, or a lake with a table
        `mission`, as LAKE or LAKE@KEY, where KEY selects a version of the table.

    Returns
    -------
    list of str
        Lines "NAME: FIRST -> SECOND", empty if the configurations are equal. BadInput is raised if `first` or `second`
        is none of these.
    """
    return list(differences(load_configuration(first), load_configuration(second)))


def load_configuration(name: str) -> MissionConfiguration:
    """Return the mission configuration that a text names.

    The text is a list of statuses in order of preference ("REQ,DES"), the path of a request file, or a lake with a
    table `mission`, as LAKE or LAKE@KEY, where KEY selects a version of the table. BadInput is raised for any other
    text.
    """
    statuses = tuple(name.split(","))
    if all(status in STATUSES for status in statuses):
        return resolve(ladder=statuses)
    root, _, key = name.partition("@")
    for lake, version in ((name, None), (root, key or None)):
        if _is_folder(lake):
            return read_back(read.version(layout.resolve_lake(lake), "mission", version))
    try:
        user_files.check_file(Path(name), "request")
    except BadInput as error:
        raise BadInput(f"{error}: neither a request nor a ladder of {', '.join(STATUSES)} nor a lake") from None
    return _configuration_of_request(Path(name))


def _is_folder(name: str) -> bool:
    try:
        return Path(name).is_dir()
    except OSError:
        return False


def _configuration_of_request(path: Path) -> MissionConfiguration:
    try:
        table = user_files.read_toml(path, "request")
    except BadInput as error:
        raise BadInput(f"request {error}") from None
    try:
        section: dict[str, Any] = table.get("mission", {})
        overrides = {
            key: (float(value["value"]), str(value["unit"])) for key, value in section.get("overrides", {}).items()
        }
        folders = [user_files.expand_path(str(name), path.parent) for name in section.get("cameras", ())]
        cameras = [camera_folder.read(folder) for folder in folders]
        return resolve(ladder=tuple(section.get("ladder", LADDER)), overrides=overrides, cameras=cameras)
    except (AttributeError, TypeError, KeyError, ValueError, OverflowError) as error:
        raise BadInput(f"request {user_files.format_path(path)}: {' '.join(str(error).split())[:300]}") from None
