"""Estimate the cost of a detector in CPU time, memory and bytes, from numbers measured by benchmarks/planner.py."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lake_schema.arrays import Float, Int
from truesky.render.channels import registry
from truesky.render.drawing import settings
from truesky.render.effects.effect import Effect
from truesky.render.exposure import truth_maps
from truesky.request.accuracy import SURVEY, Accuracy

# Bytes of a FITS header with its padding, per image; seconds per byte to write and hash a truth map.
_HEADER_BYTES, _MAP_S = 8640, 2.5e-9
# Seconds per pixel of a truth map for each effect in it, and for the frame on which stars are drawn again.
_FILLED_S = {
    "sky": {"background": 1e-8, "pixel_area": 4e-8, "straylight": 4e-8, "fringes": 2.5e-8},
    "satellites": {"satellite_trails": 2.5e-8},
    "cosmic_rays": {"cosmic_rays": 4.5e-8, "readout_cosmic_rays": 3e-8},
    "ghosts": {"ghosts": 5e-8},
    "saturation": {"bleeding": 1e-8},
}
_STARS_S = 2e-8
# Additional bytes per pixel with 32 bits, compared with 16 bits.
_WIDE_BYTES = 2.0


@dataclass(frozen=True, slots=True)
class OutputFiles:
    """Files that are written for a detector.

    Attributes
    ----------
    has_exposure_file : bool
        True if a file with all detectors of the exposure is written, too.
    readout : str
        Form of the detector image (`truesky.request.schema.READOUTS`).
    has_32_bits : bool
        True if the analogue-to-digital converters have more than 16 bits, so that files store 32 bits.
    """

    has_exposure_file: bool = False
    readout: str = "raw"
    has_32_bits: bool = False


_DETECTOR_FILES = OutputFiles()


@dataclass(frozen=True, slots=True)
class CostModel:
    """Cost of a detector: a fixed cost plus a cost per pixel and per source.

    The methods also accept arrays of pixels and sources, shape (n), for n detectors.
    """

    start_s: float
    pixel_s: float
    galaxy_s: float
    star_s: float
    start_gb: float
    pixel_gb: float
    start_bytes: int
    pixel_bytes: float
    read_bytes: float

    def seconds(self, pixels: Int | int, galaxies: Float | float, stars: Float | float) -> Any:
        """Return the time on one core in seconds.

        Parameters
        ----------
        pixels : int or int array
            Number of pixels of the detector.
        galaxies, stars : float or float array
            Number of sources on the detector.

        Returns
        -------
        float or float array
            Time in seconds.
        """
        return self.start_s + pixels * self.pixel_s + galaxies * self.galaxy_s + stars * self.star_s

    def memory(self, pixels: Int | int) -> Any:
        """Return the peak memory in GB."""
        return self.start_gb + pixels * self.pixel_gb

    def bytes(self, pixels: Int | int, read_pixels: Int | int) -> Any:
        """Return the bytes of the image and its truth maps; `read_pixels` includes prescan and overscan pixels."""
        return self.start_bytes + np.rint(pixels * self.pixel_bytes + read_pixels * self.read_bytes).astype(np.int64)


def cost_model(
    channel: str,
    sees_sky: bool,
    effects: Sequence[Effect] | None,
    accuracy: Accuracy = SURVEY,
    truth: Sequence[str] = (),
    files: OutputFiles = _DETECTOR_FILES,
) -> CostModel:
    """Return the cost model of the detectors of one kind of exposure.

    Parameters
    ----------
    channel : str
        Name of the channel.
    sees_sky : bool
        True if sources and sky are drawn.
    effects : sequence of Effect or None
        Applied effects; None if the channel has no simulator.
    accuracy : Accuracy
        Accuracy of the request.
    truth : sequence of str
        Requested truth maps.
    files : OutputFiles
        Other files that are written.

    Returns
    -------
    CostModel
        The cost per detector.

    Notes
    -----
    The error is 30 % for sources like those of the measurement.
    """
    channel_cost, applied = registry.CHANNELS[channel].cost, effects or ()
    maps = truth_maps.available_maps(truth, None if effects is None else [e.name for e in effects], sees_sky)
    accuracy_factor = settings.seconds_for(accuracy) / settings.seconds_for(SURVEY)
    map_bytes = sum(truth_maps.BYTES_PER_PIXEL[name] for name in maps)
    # The exposure file contains the science image a second time.
    images = 2 if files.has_exposure_file else 1
    written_bytes = registry.CHANNELS[channel].with_readout(files.readout).readout.file_bytes_per_pixel
    effect_names = [effect.name for effect in applied]
    map_seconds = sum(
        cost for name in maps for effect_name, cost in _FILLED_S.get(name, {}).items() if effect_name in effect_names
    )
    map_seconds += _STARS_S * ("stars" in maps)
    return CostModel(
        start_s=channel_cost.frame_s + sees_sky * channel_cost.sky_s,
        pixel_s=1e-6 * sum(effect.cost for effect in applied) + _MAP_S * map_bytes + map_seconds,
        galaxy_s=sees_sky * channel_cost.galaxy_s * accuracy_factor,
        star_s=sees_sky * channel_cost.star_s * accuracy_factor * (1 + ("stars" in maps)),
        start_gb=channel_cost.base_gb,
        pixel_gb=1e-9 * ((channel_cost.sky_bytes_per_pixel if sees_sky else channel_cost.bytes_per_pixel) + map_bytes),
        start_bytes=_HEADER_BYTES * (images + len(maps)),
        pixel_bytes=map_bytes + images * (written_bytes or 0),
        read_bytes=0.0
        if written_bytes
        else images * (channel_cost.file_bytes_per_pixel + _WIDE_BYTES * files.has_32_bits),
    )
