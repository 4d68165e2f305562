"""Estimate the CPU time, memory and disc space needed to render the image of a detector.

The numbers were measured with benchmarks/planner.py on the reference machine, an Intel Xeon with 2.5 GHz.
"""

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

# Bytes of the FITS header of an image file with its padding, for the estimated file size.
_HEADER_BYTES = 8640
# CPU seconds to write and hash a truth map (image of the true signal of one effect), per byte of the map.
_MAP_S = 2.5e-9
# CPU seconds per pixel to add the contribution of an effect to a truth map (image of a true signal), by name of the map
# and then by name of the effect.
_FILLED_S = {
    "sky": {"background": 1e-8, "pixel_area": 4e-8, "straylight": 4e-8, "fringes": 2.5e-8},
    "satellites": {"satellite_trails": 2.5e-8},
    "cosmic_rays": {"cosmic_rays": 4.5e-8, "readout_cosmic_rays": 3e-8},
    "ghosts": {"ghosts": 5e-8, "lens_ghosts": 5e-8},
    "saturation": {"bleeding": 1e-8},
}
# CPU seconds per pixel to make the truth map of stars (image of their true signal), for which stars are drawn again.
_STARS_S = 2e-8
# Memory in GB that a worker keeps from the tasks that it ran before, most of it from fluxes and from other detectors.
# Measured in runs of the demo: workers needed 2.13 and 1.67 GB for a VIS and an LSST detector, new processes 1.68 and
# 1.24 GB.
_KEPT_GB = 0.5
# Memory in GB of the charge maps of 18 exposures in two hours, which a worker keeps for persistence.
_CHARGE_MAPS_GB = 0.3
# Bytes per pixel that an image with 32 bits takes in addition to one with 16 bits.
_WIDE_BYTES = 2.0


@dataclass(frozen=True, slots=True)
class OutputFiles:
    """Format of the image files that are written for a detector.

    Attributes
    ----------
    has_exposure_file : bool
        True if a second file with all detectors of the exposure is written.
    readout : str
        Form of the images of ground cameras: "raw" (one array with all amplifiers), "amplifiers" (one array per
        amplifier) or "electrons" (electrons in the pixels before readout).
    has_32_bits : bool
        True if the analogue-to-digital converters have more than 16 bits, so that pixels are stored with 32 bits.
    """

    has_exposure_file: bool = False
    readout: str = "raw"
    has_32_bits: bool = False


_DETECTOR_FILES = OutputFiles()


@dataclass(frozen=True, slots=True)
class RampLoad:
    """Work to draw the ramp (reads without reset) of a detector, on which the time of calibration frames depends.

    Attributes
    ----------
    groups : int
        Number of groups of averaged reads; 0 for a detector that is read once.
    counted_frames : int
        Number of frames whose charge is drawn separately in every pixel, because a calibration lamp is bright; else 0.
    """

    groups: int = 0
    counted_frames: int = 0


_NO_RAMP = RampLoad()


@dataclass(frozen=True, slots=True)
class CostModel:
    """CPU time, memory and file size of a detector as linear functions of its numbers of pixels, galaxies and stars.

    Fields that end with `_s` are CPU seconds, with `_gb` gigabytes of memory, with `_bytes` bytes of files. They begin
    with `start_` (per detector), `pixel_` (per pixel of the detector), `read_` (per pixel read out, with prescan and
    overscan), `galaxy_` or `star_` (per source). At most `most_sources` sources take time. The methods also accept
    arrays of shape (n,) for n detectors.
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
    most_sources: float = np.inf

    def seconds(self, pixels: Int | int, galaxies: Float | float, stars: Float | float) -> Any:
        """Return the CPU time to render a detector, in seconds on one core of the reference machine (Xeon, 2.5 GHz).

        Parameters
        ----------
        pixels : int or int array
            Number of pixels of the detector.
        galaxies, stars : float or float array
            Expected number of galaxies and of stars on the detector.

        Returns
        -------
        float or float array
            Time in seconds.
        """
        drawn_share = np.minimum(1.0, self.most_sources / np.maximum(galaxies + stars, 1.0))
        source_s = drawn_share * (galaxies * self.galaxy_s + stars * self.star_s)
        return self.start_s + pixels * self.pixel_s + source_s

    def memory(self, pixels: Int | int) -> Any:
        """Return the peak memory in GB of a worker that renders a detector with `pixels` pixels after other tasks."""
        return self.start_gb + pixels * self.pixel_gb

    def bytes(self, pixels: Int | int, read_pixels: Int | int) -> Any:
        """Return the bytes of the files of a detector: its image and truth maps (images of the true signals).

        `pixels` is the number of light-sensitive pixels; `read_pixels` also includes prescan and overscan.
        """
        return self.start_bytes + np.rint(pixels * self.pixel_bytes + read_pixels * self.read_bytes).astype(np.int64)


def cost_model(
    channel: str,
    sees_sky: bool,
    effects: Sequence[Effect] | None,
    accuracy: Accuracy = SURVEY,
    truth: Sequence[str] = (),
    files: OutputFiles = _DETECTOR_FILES,
    ramp_load: RampLoad = _NO_RAMP,
) -> CostModel:
    """Return the model of CPU time, memory and file size for detectors with one channel, image type and effects.

    Parameters
    ----------
    channel : str
        Name of the channel: "VIS", "NISP-P", "NISP-S" or "EXT" (ground).
    sees_sky : bool
        True if the exposure shows the sky, so that sources are drawn.
    effects : sequence of Effect or None
        Detector effects that are applied; None if truesky cannot render the image type.
    accuracy : Accuracy
        Accuracy of the request, which changes the time per source.
    truth : sequence of str
        Names of the truth maps (images of the true signals of effects) that the request asks for.
    files : OutputFiles
        Format of the image files.
    ramp_load : RampLoad
        Groups and separately drawn frames of the exposure.

    Returns
    -------
    CostModel
        CPU time, memory and file size per detector.

    Raises
    ------
    KeyError
        If the channel is unknown.

    Notes
    -----
    The true CPU time differs from the model by about 30 %, for sources like those with which the model was measured.
    """
    channel_cost, applied = registry.CHANNELS[channel].cost, effects or ()
    maps = truth_maps.available_maps(truth, None if effects is None else [e.name for e in effects], sees_sky)
    accuracy_factor = settings.seconds_for(accuracy) / settings.seconds_for(SURVEY)
    map_bytes = sum(truth_maps.BYTES_PER_PIXEL[name] for name in maps)
    # If a file with all detectors of the exposure is written, it contains each science image a second time.
    images = 2 if files.has_exposure_file else 1
    written_bytes = registry.CHANNELS[channel].with_readout(files.readout).readout.file_bytes_per_pixel
    effect_names = [effect.name for effect in applied]
    # Images of the sky have the time of their groups in `sky_s`.
    ramp_s = channel_cost.group_s * ramp_load.groups * (not sees_sky)
    ramp_s += channel_cost.lamp_frame_s * ramp_load.counted_frames
    has_persistence = registry.CHANNELS[channel].persistence_effect is not None
    map_seconds = sum(
        cost for name in maps for effect_name, cost in _FILLED_S.get(name, {}).items() if effect_name in effect_names
    )
    map_seconds += _STARS_S * ("stars" in maps)
    return CostModel(
        start_s=channel_cost.frame_s + sees_sky * channel_cost.sky_s,
        pixel_s=1e-6 * (sum(effect.cost for effect in applied) + ramp_s) + _MAP_S * map_bytes + map_seconds,
        galaxy_s=sees_sky * channel_cost.galaxy_s * accuracy_factor,
        star_s=sees_sky * channel_cost.star_s * accuracy_factor * (1 + ("stars" in maps)),
        start_gb=channel_cost.base_gb + _KEPT_GB + _CHARGE_MAPS_GB * has_persistence,
        pixel_gb=1e-9 * ((channel_cost.sky_bytes_per_pixel if sees_sky else channel_cost.bytes_per_pixel) + map_bytes),
        start_bytes=_HEADER_BYTES * (images + len(maps)),
        pixel_bytes=map_bytes + images * (written_bytes or 0),
        read_bytes=0.0
        if written_bytes
        else images * (channel_cost.file_bytes_per_pixel + _WIDE_BYTES * files.has_32_bits),
        most_sources=channel_cost.most_sources,
    )
