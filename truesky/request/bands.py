"""Find the passbands in which the exposures of a request (a user's TOML file) are taken.

Fluxes of sources are computed in these passbands if the request does not name others.
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
    """Return the passbands of all exposures of a request, and the passbands by which sources of spectra are selected.

    In slitless spectroscopy, only sources that are bright enough in the latter passbands are drawn.

    Parameters
    ----------
    request : Request
        The request.
    mission : MissionConfiguration
        Mission parameters, which contain the bands of the ground surveys.

    Returns
    -------
    tuple of str
        Names of passbands, each once: passbands of the exposures in the order of the request, then the others.

    Raises
    ------
    BadInput
        If an observation names a band that its channels or its ground survey do not have. The message names the
        observation.
    """
    bands = [pointing.band for pointing in request.pointings]
    for i, block in enumerate(request.observations):
        try:
            bands += observation_bands(block, mission)
        except BadInput as error:
            raise BadInput(f"observation[{i}].bands: {error}") from None
    return tuple(dict.fromkeys([*bands, *_selection_bands(request)]))


def _selection_bands(request: Request) -> list[str]:
    """Return the passbands whose fluxes decide which sources are drawn in slitless spectra, such as euclid_h.

    The request need not have an exposure in them. The list is empty without slitless channels.
    """
    channels = [pointing.channel for pointing in request.pointings]
    for block in request.observations:
        channels += block.channels if block.table is None else [channel for channel, _ in block.table.kinds]
    return [SELECTION_BANDS[channel] for channel in dict.fromkeys(channels) if channel in SELECTION_BANDS]


def observation_bands(block: Observation, mission: MissionConfiguration) -> tuple[str, ...]:
    """Return the passbands in which an observation may take exposures.

    Parameters
    ----------
    block : Observation
        The observation, a block of exposures.
    mission : MissionConfiguration
        Mission parameters, which contain the bands of the ground surveys.

    Returns
    -------
    tuple of str
        Names of the passbands in the order of the channels. If the observation names no band of a channel, all bands of
        this channel; the blue grism only if the observation uses it.

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
    # If the observation names no filter of a channel, all filters of this channel are used.
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
