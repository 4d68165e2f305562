"""What a detector of a channel costs, measured: seconds, memory, bytes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Cost:
    """Of a channel's detectors, its effects left out; python -m benchmarks.planner measures it.

    frame_s      : s of any frame: its task, its writing;  sky_s : more, where the sky is drawn
    galaxy_s, star_s : s of a source drawn with the accuracy "survey"
    base_gb      : of a worker before it draws
    held, held_sky : bytes a pixel while a frame is made, without and with a sky
    written      : bytes a pixel of the image, pre- and overscan counted
    again_s      : s of a frame of the sky that is drawn again, for what it left in a later one
    """

    frame_s: float
    sky_s: float
    galaxy_s: float
    star_s: float
    base_gb: float
    bytes_per_pixel: float
    sky_bytes_per_pixel: float
    file_bytes_per_pixel: float
    redraw_s: float = 0.0
