"""Draw gain, read noise, full well and bias level of the quadrants of VIS, and print amplifier_values_vis.csv.

    python -m scripts.draw_vis_amplifiers > lake_schema/mission/models/amplifier_values_vis.csv

Values of single quadrants in flight are not public. The means are the numbers of the mission database for the whole
camera. The spreads are assumed, within the 1 to 3 % (gain) and about 5 % (read noise) that readouts of this kind have.
Deviations have a normal distribution. They are limited to 2.5 standard deviations, so that no quadrant is implausible.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lake_schema.arrays import Float
from lake_schema.mission import detector_overrides
from lake_schema.mission.configuration import MissionConfiguration, resolve
from truesky.randomness import rng

# Standard deviation of the values of quadrants, divided by their mean, and number of decimal places in the table.
SPREADS = {"gain": (0.02, 4), "read_noise": (0.05, 3), "full_well": (0.03, 0), "bias": (0.1, 1)}
# Largest deviation in standard deviations.
_LIMIT = 2.5
_HEAD = """# VIS: gain, read noise, full well and bias level of each quadrant, as simulated: drawn at random about the
# numbers of the camera by scripts/draw_vis_amplifiers.py. All are used relative to the medians of this table.
# gain: electron / adu; read_noise, full_well: electron; bias: adu.
detector,amplifier,gain,read_noise,full_well,bias"""


def lines(mission: MissionConfiguration) -> Iterator[str]:
    """Yield the lines of the table, from the means in the mission database."""
    yield from _HEAD.splitlines()
    places = [
        (detector, amplifier)
        for detector in detector_overrides.detectors("vis", mission)
        for amplifier in detector_overrides.amplifiers("vis", mission)
    ]
    columns = [
        [f"{value:.{places_after_point}f}" for value in _draw(name, mission.value(f"vis.{name}"), spread, len(places))]
        for name, (spread, places_after_point) in SPREADS.items()
    ]
    for place, *values in zip(places, *columns, strict=True):
        yield ",".join((*place, *values))


def _draw(name: str, mean: float, spread: float, count: int) -> Float:
    """Return `count` random values of the parameter `name`: their median is `mean`, their relative rms `spread`."""
    normal = np.clip(rng.stream(0, "vis.amplifier_values", name).standard_normal(count), -_LIMIT, _LIMIT)
    normal = (normal - np.median(normal)) / normal.std()
    return np.asarray(mean * (1.0 + spread * normal))


if __name__ == "__main__":
    print("\n".join(lines(resolve())))
