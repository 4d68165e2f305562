"""What a detector costs: seconds of a core, memory and bytes, from numbers that benchmarks/planner.py measures.

Files        what is written of a detector
price        what every detector of a kind of exposure costs
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

# A FITS header and its padding, one an image; s a byte of a truth map, to write and hash it.
_HEADER_BYTES, _MAP_S = 8640, 2.5e-9
# s a pixel of a map, for each effect that fills it in; and of the stars' own frame, on which they are drawn again.
_FILLED_S = {
    "sky": {"background": 1e-8, "pixel_area": 4e-8, "straylight": 4e-8, "fringes": 2.5e-8},
    "satellites": {"satellite_trails": 2.5e-8},
    "cosmic_rays": {"cosmic_rays": 4.5e-8, "readout_cosmic_rays": 3e-8},
    "ghosts": {"ghosts": 5e-8},
    "saturation": {"bleeding": 1e-8},
}
_STARS_S = 2e-8
# Of a pixel that has 32 bits, more than of one that has 16.
_WIDE_BYTES = 2.0


@dataclass(frozen=True, slots=True)
class OutputFiles:
    """What is written of it.

    whole   : whether its exposure has a file, too
    readout : how its own is wanted (truesky.request.schema.READOUTS)
    wide    : whether its converters have more than 16 bits, of which a file has 32
    """

    has_exposure_file: bool = False
    readout: str = "raw"
    has_32_bits: bool = False


_DETECTOR_FILES = OutputFiles()


@dataclass(frozen=True, slots=True)
class CostModel:
    """What a detector of so many pixels and sources takes: something to start with, and something for each of them.

    Of many detectors where pixels and sources are arrays [n].
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
        """Of one core."""
        return self.start_s + pixels * self.pixel_s + galaxies * self.galaxy_s + stars * self.star_s

    def memory(self, pixels: Int | int) -> Any:
        """GB at the peak."""
        return self.start_gb + pixels * self.pixel_gb

    def bytes(self, pixels: Int | int, read_pixels: Int | int) -> Any:
        """Of the image and its truth maps; read : pixels of the image, with those beside the detector's own."""
        return self.start_bytes + np.rint(pixels * self.pixel_bytes + read_pixels * self.read_bytes).astype(np.int64)


def cost_model(
    channel: str,
    sees_sky: bool,
    effects: Sequence[Effect] | None,
    accuracy: Accuracy = SURVEY,
    truth: Sequence[str] = (),
    files: OutputFiles = _DETECTOR_FILES,
) -> CostModel:
    """What detectors of one kind of exposure cost.

    looks   : whether the sky is drawn;  effects : that are applied; None = nothing renders the channel yet
    truth   : maps that are wanted;  files : what is written besides
    channel : its name;  accuracy : of the request
    Error   : 30 % where the sources are as those that it was measured with
    """
    channel_cost, applied = registry.CHANNELS[channel].cost, effects or ()
    maps = truth_maps.available_maps(truth, None if effects is None else [e.name for e in effects], sees_sky)
    accuracy_factor = settings.seconds_for(accuracy) / settings.seconds_for(SURVEY)
    map_bytes = sum(truth_maps.BYTES_PER_PIXEL[name] for name in maps)
    # An exposure's file has the science image a second time.
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
