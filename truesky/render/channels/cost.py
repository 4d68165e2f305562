"""Define the measured costs (CPU time, memory, file size) to render an image of a detector."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Cost:
    """Costs to render an image of a detector, without its effects, measured by python -m benchmarks.planner.

    Times are CPU seconds on the reference machine (an Intel Xeon with 2.5 GHz).

    Attributes
    ----------
    frame_s : float
        Seconds per image for the start of its task and for writing the file.
    sky_s : float
        Additional seconds per image if the sky with its sources is drawn.
    galaxy_s, star_s : float
        Seconds per galaxy and per star on the detector, at the accuracy "survey". They include the sources around the
        detector whose light is drawn on it.
    base_gb : float
        Memory of a new process in GB before it draws.
    bytes_per_pixel, sky_bytes_per_pixel : float
        Bytes of memory per pixel while an image is made, without and with the sky.
    file_bytes_per_pixel : float
        Bytes of the file per pixel that is read out, including prescan and overscan.
    redraw_s : float
        Seconds to draw the charge map of an image of the sky, because it leaves persistence; 0 without persistence. The
        map is drawn once for all later images of a detector.
    release_s : float
        Seconds to compute the charge that is released in an image because of one earlier image; 0 without persistence.
    group_s : float
        Additional seconds per million pixels for each group of reads of a ramp, in images without the sky. Images of
        the sky have this time in `sky_s`. 0 for detectors that are read once.
    lamp_frame_s : float
        Additional seconds per million pixels for each frame of a ramp, if a calibration lamp is so bright that the
        charge of each frame is drawn separately.
    most_sources : float
        Largest number of sources on a detector to which `galaxy_s` and `star_s` apply. In deeper catalogues, further
        sources are too faint to be drawn.
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
    release_s: float = 0.0
    group_s: float = 0.0
    lamp_frame_s: float = 0.0
    most_sources: float = math.inf
