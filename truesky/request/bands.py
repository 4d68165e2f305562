"""Find the passbands in which the exposures of a request (a user's TOML file) are taken.

Fluxes of sources are computed in these passbands if the request does not name others. A request without exposures has
the passbands of `DEFAULT_BANDS`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lake_schema.errors import BadInput
from lake_schema.tables.exposures import EUCLID_BANDS, SELECTION_BANDS
from truesky.request import instruments
from truesky.request.exposures.observations import Observation
from truesky.request.schema import Request

# Passbands in which fluxes are computed for a request that names none and has no exposures: the bands of Euclid's
# images and of the Rubin Observatory.
DEFAULT_BANDS = (
    "euclid_vis", "euclid_y", "euclid_j", "euclid_h", "lsst_u", "lsst_g", "lsst_r", "lsst_i", "lsst_z", "lsst_y",
)  # fmt: skip

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
            raise error.with_prefix(f"observation[{i}].bands") from None
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
    available, owner = instruments.observable_bands(block.channels, block.survey, block.blue, mission)
    for band in block.bands:
        instruments.check_band(band, available, owner, "")
    selected = tuple(band for band in available if not block.bands or band in block.bands)
    if "EXT" in block.channels:
        return selected
    # If the observation names no filter of a channel, all filters of this channel are used.
    return tuple(
        band
        for channel in block.channels
        for band in EUCLID_BANDS[channel]
        if band in available and (band in selected or not set(selected) & set(EUCLID_BANDS[channel]))
    )
