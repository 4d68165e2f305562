"""Measure and map how many exposures observe each position of the sky.

    python -m truesky.render.coverage --lake LAKE [--name REQUEST] --out coverage.png

The plan of a request is sufficient; no images are needed.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema import command, sky, user_files
from lake_schema.arrays import Bool, Int
from lake_schema.errors import BadInput
from lake_schema.store import layout, read
from truesky.render.camera import footprints, pointing
from truesky.render.channels.image_types import SKY_TYPES
from truesky.render.planning import exposure_chunks
from truesky.request.area import Area

_EXPOSURE_COLUMNS = ("exposure_id", "channel", "band", "image_type", "exposure_time_s", "ra", "dec")
_TASK_COLUMNS = ("exposure_id", "ra", "dec", "radius", "s_region")
# Pixels along a side of a map; largest width of a map, deg; distance from the edge of the area to its interior, deg.
_SIDE, _WIDEST, _INSIDE = 500, 60.0, 0.5
# Number of colours in a map, fraction of positions with the highest counts that share the last colour, and the colour
# of positions that are not observed.
_COLOURS, _TAIL_FRACTION, _UNSEEN_COLOUR = 8, 0.01, "#efece6"


@dataclass(frozen=True, slots=True)
class Depth:
    """Number of exposures of a band at the positions of a map.

    Attributes
    ----------
    channel, band : str
        Names of the channel and of the band.
    exposures : int
        Number of exposures of the band.
    counts : int array, shape (side, side)
        Number of exposures at each position; x points west, y north.
    interior : bool array, shape (side, side)
        Positions more than 0.5 deg inside the area of the request, or half of the largest depth if the area is small.
    extent : float
        Half the width of the map in degrees.
    """

    channel: str
    band: str
    exposures: int
    counts: Int
    interior: Bool
    extent: float

    def share(self, min_exposures: int) -> float:
        """Return the fraction of the interior that at least `min_exposures` exposures observe."""
        return float((self.counts[self.interior] >= min_exposures).mean()) if self.interior.any() else 0.0


def depths(exposures: pa.Table, tasks: Callable[[], Iterable[pa.Table]], area: Area, side: int = _SIDE) -> list[Depth]:
    """Count the exposures at each position, for every channel and band that observes the sky.

    Parameters
    ----------
    exposures : pyarrow.Table
        Rows of the table `exposures`.
    tasks : callable
        Returns the rows of the table `tasks`, one table per partition; called twice.
    area : Area
        Area of the request, which defines the interior.
    side : int
        Pixels along each side of the map.

    Returns
    -------
    list of Depth
        One map per channel and band.

    Raises
    ------
    BadInput
        If there are no exposures of the sky, or they are too far apart for a map.

    Notes
    -----
    Exposures up to half as long as the longest one of a band are not counted.
    """
    sky_exposures = exposures.filter(pc.is_in(exposures["image_type"], pa.array(SKY_TYPES)))
    if not sky_exposures.num_rows:
        raise BadInput("table exposures has no exposures of the sky")
    ra0, dec0 = _centre(sky_exposures)
    max_distance = float(
        np.max(sky.separation(sky_exposures["ra"].to_numpy(), sky_exposures["dec"].to_numpy(), ra0, dec0))
    )
    _refuse_wide(max_distance)
    extent = max_distance + max(_reach(task_rows, sky_exposures) for task_rows in tasks())
    _refuse_wide(extent)
    # The map is square on the tangent plane, with x to the west.
    grid = np.tan(np.radians(extent)) * np.degrees(1.0) * 3600.0 * np.linspace(-1.0, 1.0, side)
    x, y = np.meshgrid(grid, grid)
    ra, dec = (a.ravel() for a in pointing.sky_of_plane(x, y, ra0, dec0, 0.0))
    inside = area.depth(ra, dec)
    interior = (inside > min(_INSIDE, 0.5 * float(inside.max()))).reshape(side, side)
    channel_bands = sky_exposures.group_by(["channel", "band"]).aggregate([]).to_pylist()
    long_exposures = {
        kind: _long_exposures(sky_exposures, *kind)
        for kind in sorted((row["channel"], row["band"]) for row in channel_bands)
    }
    counts = {kind: np.zeros(side * side, np.int64) for kind in long_exposures}
    for task_rows in tasks():
        for kind, numbers in long_exposures.items():
            counts[kind] += footprints.counts(task_rows.filter(pc.is_in(task_rows["exposure_id"], numbers)), ra, dec)
    return [
        Depth(*kind, len(long_exposures[kind]), counts[kind].reshape(side, side), interior, extent)
        for kind in long_exposures
    ]


def _refuse_wide(extent: float) -> None:
    if 2.0 * extent > _WIDEST:
        raise BadInput(f"the exposures extend over {2 * extent:.0f} deg, a map over at most {_WIDEST:g} deg")


def _long_exposures(exposures: pa.Table, channel: str, band: str) -> pa.Array:
    """Return the numbers of the long exposures of a band."""
    band_exposures = exposures.filter(
        pc.and_(pc.equal(exposures["channel"], channel), pc.equal(exposures["band"], band))
    )
    is_long = pc.greater(band_exposures["exposure_time_s"], 0.5 * pc.max(band_exposures["exposure_time_s"]).as_py())
    return band_exposures.filter(is_long)["exposure_id"].combine_chunks()


def _centre(exposures: pa.Table) -> tuple[float, float]:
    x, y, z = pointing.basis(exposures["ra"].to_numpy(), exposures["dec"].to_numpy())[2].sum(axis=1)
    return float(np.degrees(np.arctan2(y, x)) % 360.0), float(np.degrees(np.arctan2(z, np.hypot(x, y))))


def _reach(tasks: pa.Table, exposures: pa.Table) -> float:
    """Return the largest distance (deg) from the boresight that tasks of the exposures observe; 0 without tasks."""
    indices = pc.index_in(tasks["exposure_id"], exposures["exposure_id"].combine_chunks()).combine_chunks()
    matched_tasks, indices = tasks.filter(pc.is_valid(indices)), indices.drop_null()
    ra, dec = (exposures[name].take(indices).to_numpy() for name in ("ra", "dec"))
    distances = (
        sky.separation(matched_tasks["ra"].to_numpy(), matched_tasks["dec"].to_numpy(), ra, dec)
        + matched_tasks["radius"].to_numpy()
    )
    return float(np.max(distances, initial=0.0))


def summary_line(depth: Depth) -> str:
    """Return one line that summarises the depth of a band."""
    shares = ", ".join(f">= {n}: {depth.share(n):.3f}" for n in range(1, 5))
    return f"{depth.channel:7} {depth.band:12} {depth.exposures:6,} exposures   fraction of the interior {shares}"


def draw_maps(depth_maps: Sequence[Depth], path: Path) -> None:
    """Draw one map per band, north up and east to the left, with the interior outlined."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import BoundaryNorm
    from matplotlib.figure import Figure

    columns = int(np.ceil(np.sqrt(len(depth_maps))))
    rows = -(-len(depth_maps) // columns)
    figure = Figure(figsize=(5.6 * columns, 5.2 * rows), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    colours = matplotlib.colormaps["viridis"].with_extremes(under=_UNSEEN_COLOUR)
    for axes, depth in zip(np.ravel(figure.subplots(rows, columns, squeeze=False)), depth_maps, strict=False):
        observed = depth.counts[depth.counts > 0]
        max_count = int(np.quantile(observed, 1.0 - _TAIL_FRACTION)) if observed.size else 1
        step = -(-max_count // _COLOURS)
        bounds = 0.5 + step * np.arange(-(-max_count // step) + 1)
        half = depth.extent
        # The x axis of the map points west.
        map_image = axes.imshow(
            np.minimum(depth.counts, max_count), origin="lower", extent=(half, -half, -half, half), cmap=colours,
            interpolation="nearest", norm=BoundaryNorm(bounds, colours.N),
        )  # fmt: skip
        if depth.interior.any() and not depth.interior.all():
            axes.contour(
                depth.interior.astype(float), [0.5], extent=(half, -half, -half, half), colors="r", linewidths=1.2
            )
        axes.set_title(f"{depth.channel} {depth.band}: >= 3 over {100 * depth.share(3):.1f} %", fontsize=11)
        axes.set_xlabel("east [deg]")
        axes.set_ylabel("north [deg]")
        bar = figure.colorbar(map_image, ax=axes, shrink=0.8, label="exposures")
        lowest = [round(b + 0.5) for b in bounds[:-1]]
        labels = [f"{a}" if step == 1 else f"{a} - {a + step - 1}" for a in lowest]
        bar.set_ticks(list((bounds[:-1] + bounds[1:]) / 2), labels=[*labels[:-1], f">= {lowest[-1]}"])
    for axes in figure.axes:
        if not axes.has_data():
            axes.set_visible(False)
    figure.savefig(path, metadata={"Software": None})


def area_of(version: read.Version) -> Area:
    """Return the area of the request that a plan was made for."""
    facts = version.manifest["facts"]["request"]["area"]
    box = facts["box"]
    return Area(
        **{
            **facts,
            "vertices": tuple(map(tuple, facts["vertices"])),
            "box": None if box is None else tuple(box),
            "patches": tuple(map(tuple, facts["patches"])),
        }
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Print a line per band and draw the maps."""
    parser = argparse.ArgumentParser(
        prog="python -m truesky.render.coverage", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--lake", required=True, help="folder of the lake, with a plan")
    parser.add_argument("--name", help="name of the request, required if the lake has several")
    parser.add_argument("--out", type=Path, help="PNG of the maps")
    options = parser.parse_args(argv)
    return command.run("coverage", lambda: _write_maps(options.lake, options.name, options.out))


def _write_maps(lake: str, name: str | None, out: Path | None) -> int:
    if out is not None:
        user_files.check_target(out, (".png",))
    root = layout.resolve_lake(lake)
    exposures, tasks = (read.version(root, table, request=name) for table in ("exposures", "tasks"))
    depth_maps = depths(
        exposures.rows(_EXPOSURE_COLUMNS),
        partial(exposure_chunks.rows_by_partition, tasks, _TASK_COLUMNS),
        area_of(exposures),
    )
    for depth in depth_maps:
        print(summary_line(depth))
    if out is not None:
        draw_maps(depth_maps, out)
        print(out)
    return 0


if __name__ == "__main__":
    command.exit_with_status(main)
