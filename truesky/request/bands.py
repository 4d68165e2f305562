"""Find the passbands in which the exposures of a request are taken.

Fluxes are computed in these passbands if the request does not name others.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from lake_schema.errors import BadInput
from lake_schema.tables.exposures import EUCLID_BANDS, SELECTION_BANDS
from truesky.request.observations import Observation
from truesky.request.schema import Request

if TYPE_CHECKING:
    from lake_schema.mission.configuration import MissionConfiguration


def requested_bands(request: Request, mission: MissionConfiguration) -> tuple[str, ...]:
    """Return the passbands of all pointings and observations, then the passbands in which sources are selected.

    Parameters
    ----------
    request : Request
        The request.
    mission : MissionConfiguration
        Mission parameters, with the bands of the ground surveys.

    Returns
    -------
    tuple of str
        Each passband once, in the order of the request.

    Raises
    ------
    BadInput
        If no channel of an observation has a band that the observation names. The message names the observation.
    """
    bands = [pointing.band for pointing in request.pointings]
    for i, block in enumerate(request.observations):
        try:
            bands += observation_bands(block, mission)
        except BadInput as error:
            raise BadInput(f"observation[{i}].bands: {error}") from None
    return tuple(dict.fromkeys([*bands, *_selection_bands(request)]))


def _selection_bands(request: Request) -> list[str]:
    """Return the passbands in which sources are selected; the request may have no exposure in them."""
    channels = [pointing.channel for pointing in request.pointings]
    for block in request.observations:
        channels += block.channels if block.table is None else [channel for channel, _ in block.table.kinds]
    return [SELECTION_BANDS[channel] for channel in dict.fromkeys(channels) if channel in SELECTION_BANDS]


def observation_bands(block: Observation, mission: MissionConfiguration) -> tuple[str, ...]:
    """Return the passbands in which an observation may take exposures.

    Parameters
    ----------
    block : Observation
        The observation.
    mission : MissionConfiguration
        Mission parameters, with the bands of the ground surveys.

    Returns
    -------
    tuple of str
        The passbands.

    Raises
    ------
    BadInput
        If the observation names a passband that its channels or its ground survey do not have.
    """
    if block.table is not None:
        return block.table.bands
    if "EXT" in block.channels:
        rules = [row for row in mission.rows("survey.external") if row["survey"] == block.survey]
        return _select(block.bands, [b for rule in rules for b in rule["bands"].split()], f"survey {block.survey}")
    available = [b for channel in block.channels for b in EUCLID_BANDS[channel] if b != "nisp_blue" or block.blue]
    selected = _select(block.bands, available, ", ".join(block.channels))
    # A channel without any named filter uses all its filters.
    return tuple(
        band
        for channel in block.channels
        for band in EUCLID_BANDS[channel]
        if band in available and (band in selected or not set(selected) & set(EUCLID_BANDS[channel]))
    )


def _select(requested: Sequence[str], available: Sequence[str], owner: str) -> tuple[str, ...]:
    if unknown := [band for band in requested if band not in available]:
        raise BadInput(f"{owner} has no band {unknown[0]!r} ({', '.join(available)})")
    return tuple(band for band in available if not requested or band in requested)
