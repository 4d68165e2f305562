"""All channels (instrument modes), by the name that they have in the table `exposures`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from lake_schema.errors import BadInput
from truesky.render.channels.channel import Channel
from truesky.render.effects.effect import Effect


def _vis() -> Channel:
    from truesky.render.channels import vis

    return vis.CHANNEL


def _nisp_p() -> Channel:
    from truesky.render.channels import nisp_p

    return nisp_p.CHANNEL


def _nisp_s() -> Channel:
    from truesky.render.channels import nisp_s

    return nisp_s.CHANNEL


def _ground() -> Channel:
    from truesky.render.channels import ground

    return ground.CHANNEL


class _Channels(Mapping[str, Channel]):
    """Channels by name; the module of a channel is imported when the channel is first used.

    A process thus imports only the effects of the channels that it plans or renders.
    """

    def __init__(self, functions: Mapping[str, Callable[[], Channel]]) -> None:
        self._functions = functions

    def __getitem__(self, name: str) -> Channel:
        return self._functions[name]()

    def __contains__(self, name: object) -> bool:
        return name in self._functions

    def __iter__(self) -> Iterator[str]:
        return iter(self._functions)

    def __len__(self) -> int:
        return len(self._functions)


CHANNELS: Mapping[str, Channel] = _Channels({"VIS": _vis, "NISP-P": _nisp_p, "NISP-S": _nisp_s, "EXT": _ground})


def find_channel(name: str, image_type: str, where: str) -> Channel:
    """Return the channel of a name, if it can render an image type.

    Parameters
    ----------
    name : str
        Name of the channel: "VIS", "NISP-P", "NISP-S" or "EXT" (ground).
    image_type : str
        Image type, such as "science" or "dark".
    where : str
        Place in the user's input that gives the names, quoted in the error message.

    Returns
    -------
    Channel
        The channel.

    Raises
    ------
    BadInput
        If there is no channel of that name, or if it cannot render the image type.
    """
    if name not in CHANNELS:
        raise BadInput(f"{where}: channel {name!r} is not one of {', '.join(CHANNELS)}")
    effects_by_type = CHANNELS[name].effects
    if image_type not in effects_by_type:
        raise BadInput(f"{where}: {name} has no image type {image_type!r}, only {', '.join(effects_by_type)}")
    return CHANNELS[name]


def find_effects(name: str, image_type: str, where: str) -> tuple[Effect, ...]:
    """Return the effects of telescope, detector and electronics for an image type of a channel.

    Parameters
    ----------
    name : str
        Name of the channel: "VIS", "NISP-P", "NISP-S" or "EXT" (ground).
    image_type : str
        Image type, such as "science" or "dark".
    where : str
        Place in the user's input that gives the names, quoted in the error message.

    Returns
    -------
    tuple of Effect
        Effects in the order in which they are applied.

    Notes
    -----
    `find_channel` raises BadInput if the channel is unknown or cannot render the image type.
    """
    return find_channel(name, image_type, where).effects[image_type]


def find_effects_or_none(name: str, image_type: str) -> tuple[Effect, ...] | None:
    """Return the effects of telescope, detector and electronics for an image type of a channel.

    `name` is the name of the channel, such as "NISP-S", and `image_type` for example "science" or "dark". The effects
    are in the order in which they are applied. The result is None if the channel is unknown or cannot render the type.
    """
    channel = CHANNELS.get(name)
    return None if channel is None else channel.effects.get(image_type)
