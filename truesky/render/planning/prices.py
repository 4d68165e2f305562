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
class Files:
    """What is written of it.

    whole   : whether its exposure has a file, too
    readout : how its own is wanted (truesky.request.schema.READOUTS)
    wide    : whether its converters have more than 16 bits, of which a file has 32
    """

    whole: bool = False
    readout: str = "raw"
    wide: bool = False


_ITS_OWN = Files()


@dataclass(frozen=True, slots=True)
class Price:
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

    def bytes(self, pixels: Int | int, read: Int | int) -> Any:
        """Of the image and its truth maps; read : pixels of the image, with those beside the detector's own."""
        return self.start_bytes + np.rint(pixels * self.pixel_bytes + read * self.read_bytes).astype(np.int64)


def price(
    channel: str,
    looks: bool,
    effects: Sequence[Effect] | None,
    accuracy: Accuracy = SURVEY,
    truth: Sequence[str] = (),
    files: Files = _ITS_OWN,
) -> Price:
    """What detectors of one kind of exposure cost.

    looks   : whether the sky is drawn;  effects : that are applied; None = nothing renders the channel yet
    truth   : maps that are wanted;  files : what is written besides
    channel : its name;  accuracy : of the request
    Error   : 30 % where the sources are as those that it was measured with
    """
    own, applied = registry.CHANNELS[channel].cost, effects or ()
    maps = truth_maps.made(truth, None if effects is None else [e.name for e in effects], looks)
    tier = settings.seconds_for(accuracy) / settings.seconds_for(SURVEY)
    mapped = sum(truth_maps.BYTES[name] for name in maps)
    # An exposure's file has the science image a second time.
    images = 2 if files.whole else 1
    own_pixels = registry.CHANNELS[channel].read_as(files.readout).readout.written
    names = [effect.name for effect in applied]
    filled = sum(cost for name in maps for by, cost in _FILLED_S.get(name, {}).items() if by in names)
    filled += _STARS_S * ("stars" in maps)
    return Price(
        start_s=own.frame_s + looks * own.sky_s,
        pixel_s=1e-6 * sum(effect.cost for effect in applied) + _MAP_S * mapped + filled,
        galaxy_s=looks * own.galaxy_s * tier,
        star_s=looks * own.star_s * tier * (1 + ("stars" in maps)),
        start_gb=own.base_gb,
        pixel_gb=1e-9 * ((own.held_sky if looks else own.held) + mapped),
        start_bytes=_HEADER_BYTES * (images + len(maps)),
        pixel_bytes=mapped + images * (own_pixels or 0),
        read_bytes=0.0 if own_pixels else images * (own.written + _WIDE_BYTES * files.wide),
    )
