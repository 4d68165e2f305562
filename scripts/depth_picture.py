"""Draw the depth and the mask bits of a field from the table `depth` of a lake.

    python -m scripts.depth_picture LAKE BAND OUT.jpg [--other BAND]

The upper maps show the 5 sigma depth of point sources, the lower ones the mask. With --other, a second band is drawn to
the right.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from lake_schema import sky
from lake_schema.store import read
from lake_schema.tables.survey.depth import BAD_PIXELS, BRIGHT_STAR, EDGE, GHOST, ORDER, SATELLITE, SATURATED, SPIKE
from truesky.render.camera import pointing
from truesky.survey_maps.depth_lookup import read_depth_map

# Pixels along each side of a map.
_SIDE = 900
# Colours of the mask bits, from the lowest layer to the highest.
_COLOURS = (
    (0, "observed", "#dfe7ef"), (EDGE, "edge of a detector", "#9fb3c8"), (BRIGHT_STAR, "halo", "#f2b447"),
    (SPIKE, "spike", "#c8553d"), (GHOST, "ghost", "#7b2d8b"), (SATELLITE, "satellite", "#2a9d8f"),
    (BAD_PIXELS, "bad pixels", "#e9c7c2"), (SATURATED, "saturated", "#000000"),
)  # fmt: skip


def main() -> None:
    """Draw the maps that the arguments of the program select."""
    import matplotlib
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("lake", type=Path)
    parser.add_argument("band")
    parser.add_argument("out", type=Path)
    parser.add_argument("--other")
    options = parser.parse_args()
    version = read.version(options.lake, "depth")
    bands = [options.band, *([options.other] if options.other else [])]
    maps = [read_depth_map(version, band, ["depth_point", "mask"]) for band in bands]
    ra, dec = sky.cell_centres(ORDER, maps[0].pixels)
    ra0, dec0 = (0.5 * (float(v.min()) + float(v.max())) for v in (ra, dec))
    half = 0.52 * (float(dec.max()) - float(dec.min()))
    grid = 3600.0 * half * np.linspace(-1.0, 1.0, _SIDE)
    places = pointing.sky_of_plane(*np.meshgrid(grid, grid), ra0, dec0, 0.0)
    figure = Figure(figsize=(5.6 * len(maps) + 1.6, 9.6), dpi=100, layout="constrained")
    panels = figure.subplots(2, len(maps), squeeze=False)
    layers = ListedColormap([colour for *_, colour in _COLOURS])
    for column, depth in enumerate(maps):
        row = depth.rows_at(*places)
        values = np.where(row >= 0, depth.columns["depth_point"][row], np.nan)
        low, high = np.nanquantile(values, [0.02, 0.98])
        depth_image = panels[0, column].imshow(
            values, origin="lower", extent=(half, -half, -half, half), cmap=matplotlib.colormaps["viridis"],
            vmin=low - 0.02, vmax=high + 0.02, interpolation="nearest",
        )  # fmt: skip
        figure.colorbar(depth_image, ax=panels[0, column], label="AB mag, 5 sigma, point source")
        panels[0, column].set_title(depth.band)
        mask = np.full(row.shape, np.nan)
        for number, (bit, *_) in enumerate(_COLOURS):
            mask[(row >= 0) & ((depth.columns["mask"][row] & bit) == bit)] = number
        panels[1, column].imshow(
            mask, origin="lower", extent=(half, -half, -half, half), cmap=layers, vmin=-0.5, vmax=len(_COLOURS) - 0.5,
            interpolation="nearest",
        )  # fmt: skip
        for axes in panels[:, column]:
            axes.set_xlabel("east [deg]")
            axes.set_ylabel("north [deg]")
    panels[1, -1].legend(
        handles=[Patch(color=colour, label=label) for _, label, colour in _COLOURS], loc="upper left",
        bbox_to_anchor=(1.02, 1.0), frameon=False,
    )  # fmt: skip
    figure.savefig(options.out, pil_kwargs={"quality": 88})


if __name__ == "__main__":
    main()
