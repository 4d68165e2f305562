"""Effects of VIS: what each costs, how much of the image it changes, and whether a nominal scene asks for it.

One full detector with a made-up sky of points and squares; each effect acts on what those before it left.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from functools import partial

import numpy as np

from benchmarks import report
from jobs.render import focal_plane
from jobs.render.channels import vis
from jobs.render.effects import quadrants
from jobs.render.effects.effect import Frame, Lights, Scene
from jobs.rng import stream
from lake_schema.mission.configuration import resolve

# Sources of the scene, and the brightest light, electrons.
_SOURCES, _STARS, _LIGHT = 30_000, 200, 1e9
_EXPOSURE, _SKY = 560.53, 0.25


def light(ny: int, nx: int) -> Frame:
    """Expected electrons of points and of squares of seven pixels."""
    rng = np.random.default_rng(1)
    frame = np.zeros((ny, nx))
    share = ny * nx / (4132 * 4096)
    for electrons in 10.0 ** rng.uniform(1.0, 4.0, int(_SOURCES * share)):
        x, y = rng.integers(4, nx - 4), rng.integers(4, ny - 4)
        frame[y - 3 : y + 4, x - 3 : x + 4] += electrons / 49.0
    for electrons in 10.0 ** rng.uniform(4.0, 6.5, int(_STARS * share)):
        frame[rng.integers(0, ny), rng.integers(0, nx)] += electrons
    return frame


def measured(side: int | None, repeats: int) -> dict[str, float]:
    """Of each effect: CPU s of a detector, margin, rms and largest change of a pixel over its noise."""
    mission = resolve()
    detector = focal_plane.detector("vis", "3-4", mission)
    if side is not None:
        detector = type(detector)("3-4", "vis", side, side, detector.x, detector.y, 0.0, detector.pixel_scale)
    frame = light(detector.ny, detector.nx)
    lights = Lights(np.array([100.0]), np.array([100.0]), np.array([_LIGHT]))
    scene = Scene(mission, "vis", _EXPOSURE, _SKY, float(frame.max()), detector, lights)
    out: dict[str, float] = {}
    for effect in vis.SKY:
        parameters = effect.parameters(scene)
        after = effect.apply(frame, *parameters, rng=stream(1, effect.name))
        work = partial(effect.apply, frame, *parameters, rng=stream(1, effect.name))
        out[f"{effect.name}_s"] = report.best(work, repeats, time.process_time)
        out[f"{effect.name}_margin"] = effect.margin(scene)
        if after.shape == frame.shape and effect.name != "adc":
            change = after - frame
            out[f"{effect.name}_rms_sigma"] = float(np.sqrt(np.mean(change**2))) / scene.pixel_noise
            out[f"{effect.name}_largest_sigma"] = float(np.abs(change).max()) / scene.pixel_noise
        frame = after
    assembled = quadrants.assembled(frame, *quadrants.sizes(scene))
    out["all_s"] = sum(value for key, value in out.items() if key.endswith("_s"))
    out["mean_adu"] = float(assembled.mean())
    return out


def main(argv: Sequence[str] | None = None) -> int:
    """Measures and prints everything."""
    options = report.options("effects", __doc__ or "", argv)
    figures = measured(512 if options.quick else None, 1 if options.quick else 3)
    report.finish(
        "effects", 1 if options.quick else 3, figures, {"all_s": "CPU, every effect of a detector"}, options.json
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
