"""What a detector of a channel costs, measured: seconds, memory, bytes.

of_channel   the measured numbers of a channel, costs.csv
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cache
from importlib.resources import files


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
    with (files("jobs.render.channels") / "costs.csv").open(encoding="utf-8") as stream:
        (row,) = (row for row in csv.DictReader(stream) if row["channel"] == channel)
    return Cost(*(float(row[name]) for name in Cost.__slots__))
