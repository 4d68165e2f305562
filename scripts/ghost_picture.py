"""Draw a picture of the ghosts of VIS: both orders of a bright star, and their offsets over the focal plane.

    python -m scripts.ghost_picture [FILE]

FILE is the JPEG to write, by default docs/ghosts.jpg. The picture has no noise.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from lake_schema.mission import ghost_offsets
from lake_schema.mission.configuration import MissionConfiguration, resolve
from truesky.render.camera import detectors
from truesky.render.effects.light import ghosts
from truesky.render.effects.scene import Lights, Scene
from truesky.render.planning import planned_exposures

ROOT = Path(__file__).resolve().parents[1]
# Magnitude of the star, its detector, its column and row, and the exposure time in seconds.
_STAR, _DETECTOR, _COLUMN, _ROW, _TIME = 4.0, "2-1", 2000.0, 1200.0, 560.53
# Columns and rows around the star that are shown, and pixels that are averaged along each axis.
_COLUMNS, _ROWS, _BINNED = (-600, 200), (-150, 2050), 2


def _draw_ghosts(axes: Axes, mission: MissionConfiguration) -> None:
    """Draw the ghosts of a star near a corner of the focal plane, in electrons per pixel."""
    detector = detectors.detector("vis", _DETECTOR, mission)
    rate = 10.0 ** (0.4 * (planned_exposures.zero_point_of("vis", "euclid_vis", mission) - _STAR))
    lights = Lights(np.array([_COLUMN]), np.array([_ROW]), np.array([rate * _TIME]))
    scene = Scene(mission, "vis", _TIME, 0.22, 0.0, detector, lights)
    frame = ghosts.apply(np.zeros((detector.ny, detector.nx)), *ghosts.parameters(scene))
    columns, rows = (slice(*(int(at + n) for n in sides)) for at, sides in ((_COLUMN, _COLUMNS), (_ROW, _ROWS)))
    part = frame[rows, columns]
    part = part.reshape(len(part) // _BINNED, _BINNED, -1, _BINNED).mean(axis=(1, 3))
    extent = (_COLUMNS[0], _COLUMNS[1], _ROWS[0], _ROWS[1])
    image = axes.imshow(np.log10(part + 0.02), origin="lower", cmap="gray", extent=extent)
    bar = axes.figure.colorbar(image, ax=axes, ticks=np.log10(np.array([0.0, 0.1, 1.0, 10.0]) + 0.02), shrink=0.6)
    bar.ax.set_yticklabels(["0", "0.1", "1", "10"])
    bar.set_label("electrons per pixel")
    axes.plot(0, 0, "*", color="tab:orange")
    axes.annotate("star", (0, 0), (25, -50), color="tab:orange")
    (orders,) = ghosts.parameters(scene)
    for number, order in enumerate(orders, start=1):
        x, y = (float(moved[0]) for moved in order.offset)
        axes.annotate(f"order {number}", (x + order.pupil.radius + 25, y - 20), color="w")
    axes.set(xlabel="columns from the star", ylabel="rows from the star")
    axes.set_title(f"star of {_STAR:g} mag on detector {_DETECTOR}")


def _draw_offsets(axes: Axes, mission: MissionConfiguration) -> None:
    """Draw the offsets of both orders over the focal plane as arrows, twice as long as in the focal plane."""
    for detector in detectors.detectors("vis", mission):
        width, height = (n * detector.pixel_scale / 3600.0 for n in (detector.nx, detector.ny))
        corner = (detector.x / 3600.0 - width / 2, detector.y / 3600.0 - height / 2)
        axes.add_patch(Rectangle(corner, width, height, fill=False, edgecolor="0.8"))
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-0.35, 0.35, 6)] * 2))
    to_degrees = mission.value("vis.fpa.pixel_scale", "deg / pix")
    for order, colour in ((2, "tab:orange"), (1, "tab:blue")):
        moved = (to_degrees * part for part in ghost_offsets.offset(mission, ("vis", "ghost"), order, x, y))
        axes.quiver(
            x, y, *moved, color=colour, angles="xy", scale_units="xy", scale=0.5, width=0.005, label=f"order {order}"
        )
    axes.set(xlabel="x in the focal plane (deg)", ylabel="y in the focal plane (deg)", aspect="equal")
    axes.set(xlim=(-0.45, 0.45), ylim=(-0.45, 0.5))
    axes.set_title("offsets, twice as long as in the focal plane")
    axes.legend(loc="upper center", ncols=2, frameon=False)


def write(path: Path) -> None:
    """Write the picture to a JPEG file."""
    mission = resolve()
    figure, panels = plt.subplots(1, 2, figsize=(10.0, 6.0), layout="constrained", width_ratios=(1.0, 1.6))
    _draw_ghosts(panels[0], mission)
    _draw_offsets(panels[1], mission)
    figure.savefig(path, dpi=100, pil_kwargs={"quality": 85})
    plt.close(figure)


if __name__ == "__main__":
    write(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "ghosts.jpg")
