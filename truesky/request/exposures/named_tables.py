"""Read the table that an observation of a request names: pointings, or visits of the Rubin Observatory's scheduler."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from lake_schema import user_files
from lake_schema.errors import BadInput
from lake_schema.store import layout
from truesky.request import instruments
from truesky.request.exposures import pointing_tables, visit_tables
from truesky.request.exposures.pointing_tables import Contents
from truesky.request.toml_values import Toml, string

if TYPE_CHECKING:
    from lake_schema.mission.configuration import MissionConfiguration


def read_table(
    table: Toml,
    path: str,
    kind: tuple[tuple[str, ...], str, str | None],
    folder: Path,
    mission: MissionConfiguration | None,
) -> dict[str, Any]:
    """Read the table of pointings or of visits that an observation names.

    Parameters
    ----------
    table : Toml
        The observation.
    path : str
        Path of the observation in the request, for error messages.
    kind : (tuple of str, str, str or None)
        Channels, image type and survey of the observation; the survey is None if it is wrong.
    folder : Path
        Folder of the request.
    mission : MissionConfiguration or None
        Mission parameters; None if they are not valid.

    Returns
    -------
    dict
        Path of the file and its summary by key of the observation; {} without a table.

    Raises
    ------
    BadInput
        If the file does not exist, is outside the folder, or is not valid.
    """
    file = _pointings_file(table, path, folder)
    return {} if file is None else {"pointings": str(file), "table": _contents(file, kind, path, mission)}


def _pointings_file(table: Toml, path: str, folder: Path) -> Path | None:
    """Return the path of an observation's table of pointings, or None if it has none.

    Raises BadInput if the file is not in `folder` (the folder of the request) or below, or does not exist.
    """
    if not string(table, f"{path}.pointings", default=""):
        return None
    file = folder / string(table, f"{path}.pointings")
    try:
        return user_files.check_file(layout.check_inside(folder, file), "table of pointings")
    except BadInput as error:
        raise error.with_prefix(f"{path}.pointings") from None


def _contents(
    file: Path, kind: tuple[tuple[str, ...], str, str | None], path: str, mission: MissionConfiguration | None
) -> Contents | None:
    """Return the summary of a table of pointings or of visits; None if it cannot be read because of other mistakes."""
    channels, image_type, survey = kind
    try:
        if not visit_tables.is_table_of_visits(file):
            return pointing_tables.contents(file, channels, image_type)
        if channels != (instruments.GROUND_CHANNEL,):
            raise BadInput(f"{file} is a table of visits, which is only for channel {instruments.GROUND_CHANNEL}")
        if survey is None or mission is None:
            return None
        camera = instruments.survey_camera(survey, mission)
        bands = instruments.band_names(instruments.GROUND_CHANNEL, camera, mission)
        return pointing_tables.summarise(file, visit_tables.read(file, bands, image_type))
    except BadInput as error:
        raise error.with_prefix(f"{path}.pointings") from None
