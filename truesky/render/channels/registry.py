"""Channels that can be rendered, by their name in the table `exposures`."""

from __future__ import annotations

from collections.abc import Mapping

from lake_schema.errors import BadInput
from truesky.render.channels import ground, nisp_p, nisp_s, vis
from truesky.render.channels.channel import Channel
from truesky.render.effects.effect import Effect

CHANNELS: Mapping[str, Channel] = {
    "VIS": vis.CHANNEL,
    "NISP-P": nisp_p.CHANNEL,
    "NISP-S": nisp_s.CHANNEL,
    "EXT": ground.CHANNEL,
}


def find_channel(name: str, image_type: str, where: str) -> Channel:
    """Return a channel that renders an image type.

    Parameters
    ----------
    name : str
        Name of the channel.
    image_type : str
        Type of the images.
    where : str
        Place in the user's input, for the message.

    Returns
    -------
    Channel
        The channel.

    Raises
    ------
    BadInput
        If there is no channel of that name, or if it does not render the image type.
    """
    if name not in CHANNELS:
        raise BadInput(f"{where}: channel {name!r} is not one of {', '.join(CHANNELS)}")
    effects_by_type = CHANNELS[name].effects
    if image_type not in effects_by_type:
        raise BadInput(f"{where}: {name} has no image type {image_type!r}, only {', '.join(effects_by_type)}")
    return CHANNELS[name]


def find_effects(name: str, image_type: str, where: str) -> tuple[Effect, ...]:
    """Return the effects of an image type.

    Parameters
    ----------
    name : str
        Name of the channel.
    image_type : str
        Type of the images.
    where : str
        Place in the user's input, for the message.

    Returns
    -------
    tuple of Effect
        Effects in order.

    Notes
    -----
    `find_channel` raises BadInput if no channel renders the image type.
    """
    return find_channel(name, image_type, where).effects[image_type]


def find_effects_or_none(name: str, image_type: str) -> tuple[Effect, ...] | None:
    """Return the effects of an image type in order, or None if no channel renders it."""
    channel = CHANNELS.get(name)
    return None if channel is None else channel.effects.get(image_type)
