"""Measured costs of a detector of a channel: time, memory and file size."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Cost:
    """Costs of the detectors of a channel without effects, measured by python -m benchmarks.planner.

    Attributes
    ----------
    frame_s : float
        Time per frame for its task and for writing, s.
    sky_s : float
        Additional time if the sky is drawn, s.
    galaxy_s, star_s : float
        Time per source drawn with the accuracy "survey", s.
    base_gb : float
        Memory of a worker before it draws, GB.
    bytes_per_pixel, sky_bytes_per_pixel : float
        Memory per pixel while a frame is made, without and with sky.
    file_bytes_per_pixel : float
        Written bytes per pixel of the image, including pre- and overscan.
    redraw_s : float
        Time to draw a sky frame again for its persistence in a later one, s.
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
