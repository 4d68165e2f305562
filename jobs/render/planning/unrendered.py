"""Channels that can be planned and forecast though nothing renders them: what planning needs of any channel.

of_channel   of a channel by its name: the channel itself, where it is rendered
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from jobs.fluxes.passbands import Passband
from jobs.render.camera.detectors import Detector
from jobs.render.channels import registry
from jobs.render.channels.channel import Channel
from jobs.render.channels.cost import Cost
from jobs.render.channels.image_types import SKY_TYPES
from jobs.render.sky.diffuse_light import SkyBand
from lake_schema.mission.configuration import MissionConfiguration


@dataclass(frozen=True, slots=True)
class Unrendered:
    """What of jobs.render.channels.channel.Channel planning needs."""

    cost: Cost
    bands: Callable[[str, MissionConfiguration], tuple[str, ...]]
    sky: Callable[[Detector, str, MissionConfiguration, Passband | None], SkyBand]
    on_ground: bool = False
    sky_types: tuple[str, ...] = SKY_TYPES

    def margin(self, section: str, mission: MissionConfiguration) -> float:
        """How far beyond a detector all sources are read, arcsec."""
        return mission.value("survey.selection_margin", "arcsec")


# There is a simulator for all of them.
UNRENDERED: Mapping[str, Unrendered] = {}


def of_channel(name: str) -> Channel | Unrendered:
    """What planning needs of a channel; KeyError where there is none."""
    return registry.CHANNELS[name] if name in registry.CHANNELS else UNRENDERED[name]
