"""Channels that can be planned and forecast though nothing renders them: what planning needs of any channel.

of_channel   of a channel by its name: the channel itself, where it is rendered
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from jobs.fluxes.passbands import Passband
from jobs.render.camera import bands
from jobs.render.camera.detectors import Detector
from jobs.render.channels import registry
from jobs.render.channels.channel import Channel
from jobs.render.channels.cost import Cost
from jobs.render.channels.image_types import SKY_TYPES
from jobs.render.sky import diffuse_light
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


UNRENDERED: Mapping[str, Unrendered] = {
    # Assumed: a spectrum is 512 pixels long.
    "NISP-S": Unrendered(
        Cost(
            frame_s=30.0,
            sky_s=0.0,
            galaxy_s=5.0e-3,
            star_s=5.0e-3,
            base_gb=0.7,
            held=80.0,
            held_sky=80.0,
            written=3.0,
            assumed=True,
        ),
        bands.of_one("nisp", "nisp_red", "nisp_blue"),
        diffuse_light.thermal_sky,
    ),
}


def of_channel(name: str) -> Channel | Unrendered:
    """What planning needs of a channel; KeyError where there is none."""
    return registry.CHANNELS[name] if name in registry.CHANNELS else UNRENDERED[name]
