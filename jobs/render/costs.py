"""What a detector costs: seconds of a core, memory and bytes, from numbers that benchmarks.planner measures.

of_channel   the measured numbers of a channel, costs.csv
price        what every detector of a kind of exposure costs
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

from jobs.accuracy import SURVEY, Accuracy
from jobs.render import stamps, truth_maps
from jobs.render.effects.effect import Effect

# A FITS header and its padding, one an image; s a byte of a truth map, to make, write and hash it.
_HEADER_BYTES, _MAP_S = 8640, 7.5e-9


@dataclass(frozen=True, slots=True)
class Cost:
    """Of a channel's detectors, its effects left out.

    frame_s      : s of any frame: its task, its writing;  sky_s : more, where the sky is drawn
    galaxy_s, star_s : s of a source drawn with the accuracy "survey"
    base_gb      : of a worker before it draws
    held, held_sky : bytes a pixel while a frame is made, without and with a sky
    written      : bytes a pixel of the image, pre- and overscan counted
    """

    frame_s: float
    sky_s: float
    galaxy_s: float
    star_s: float
    base_gb: float
    held: float
    held_sky: float
    written: float


@cache
def of_channel(channel: str) -> Cost:
    """The measured numbers."""
    with (files("jobs.render") / "costs.csv").open(encoding="utf-8") as stream:
        (row,) = (row for row in csv.DictReader(stream) if row["channel"] == channel)
    return Cost(*(float(row[name]) for name in Cost.__slots__))


@dataclass(frozen=True, slots=True)
class Price:
    """What a detector of so many pixels and sources takes: something to start with, and something for each of them."""

    start_s: float
    pixel_s: float
    galaxy_s: float
    star_s: float
    start_gb: float
    pixel_gb: float
    start_bytes: int
    pixel_bytes: float

    def seconds(self, pixels: int, galaxies: float, stars: float) -> float:
        """Of one core."""
        return self.start_s + pixels * self.pixel_s + galaxies * self.galaxy_s + stars * self.star_s

    def memory(self, pixels: int) -> float:
        """GB at the peak."""
        return self.start_gb + pixels * self.pixel_gb

    def bytes(self, pixels: int) -> int:
        """Of the image and its truth maps."""
        return self.start_bytes + round(pixels * self.pixel_bytes)


def price(
    channel: str,
    looks: bool,
    effects: Sequence[Effect] | None,
    accuracy: Accuracy = SURVEY,
    truth: Sequence[str] = (),
) -> Price:
    """What detectors of one kind of exposure cost.

    looks   : whether the sky is drawn;  effects : that are applied; None = nothing renders the channel yet
    truth   : maps that are wanted
    Error   : 30 % where the sources are as those that it was measured with
    """
    own, applied = of_channel(channel), effects or ()
    maps = truth_maps.made(truth, None if effects is None else [e.name for e in effects], looks)
    tier = stamps.seconds_for(accuracy) / stamps.seconds_for(SURVEY)
    mapped = sum(truth_maps.BYTES[name] for name in maps)
    return Price(
        start_s=own.frame_s + looks * own.sky_s,
        pixel_s=1e-6 * sum(effect.cost for effect in applied) + _MAP_S * mapped,
        galaxy_s=looks * own.galaxy_s * tier,
        star_s=looks * own.star_s * tier,
        start_gb=own.base_gb,
        pixel_gb=1e-9 * ((own.held_sky if looks else own.held) + mapped),
        start_bytes=_HEADER_BYTES * (1 + len(maps)),
        pixel_bytes=own.written + mapped,
    )
