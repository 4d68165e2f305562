"""Measure and map how many exposures observe each position of the sky.

    python -m truesky.render.coverage LAKE [--name REQUEST] --out coverage.png

The stored plan of a request (its tables `exposures` and `tasks`) is sufficient; no images are needed.
"""

from __future__ import annotations

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
from truesky.command_line.parser import Parser
from truesky.render.camera import footprints, pointing
from truesky.render.channels.image_types import SKY_TYPES
from truesky.render.planning import exposure_chunks
from truesky.request.area import Area

# Columns of the table `exposures` (one row per planned exposure) that are read to make maps of the number of exposures.
_EXPOSURE_COLUMNS = ("exposure_id", "channel", "band", "image_type", "exposure_time_s", "ra", "dec")
# Columns of the table `tasks` (one row per detector of an exposure) that are read to make maps of the number of
# exposures.
_TASK_COLUMNS = ("exposure_id", "ra", "dec", "radius", "s_region")
# Pixels along each side of a map of the number of exposures.
_SIDE = 500
# Largest width of a map of the sky, deg; exposures that extend farther raise an error.
_WIDEST = 60.0
# A position counts as interior if it is inside the request's area (the sky to be observed) and at least this far from
# its edge, deg. In a small area, half of the largest distance from the edge is used instead.
_INSIDE = 0.5
# Largest number of colours in a map of the number of exposures. With more different numbers, each colour stands for a
# range of them.
_COLOURS = 8
# Positions with the most exposures share the last colour of a map; they are at least this fraction of all observed
# positions.
_TAIL_FRACTION = 0.01
# Colour of positions that no exposure observes.
_UNSEEN_COLOUR = "#efece6"


@dataclass(frozen=True, slots=True)
class Depth:
    """Map of the number of exposures in a band at each position on the sky.

    Attributes
    ----------
    channel, band : str
        Names of the channel and of the band.
    exposures : int
        Number of exposures that are counted.
    counts : int array, shape (side, side)
        Number of exposures at each position; columns run to the west, rows to the north.
    interior : bool array, shape (side, side)
        True for positions well inside the area of the request: more than 0.5 deg from its edge. If the area is small,
        more than half of the largest distance from the edge.
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
        """Return the fraction of the interior that at least `min_exposures` exposures observe; 0.0 without interior."""
        return float((self.counts[self.interior] >= min_exposures).mean()) if self.interior.any() else 0.0


def depths(exposures: pa.Table, tasks: Callable[[], Iterable[pa.Table]], area: Area, side: int = _SIDE) -> list[Depth]:
    """Count the exposures at each position on the sky, for every channel and band with science exposures.

    Parameters
    ----------
    exposures : pyarrow.Table
        Rows of the table `exposures`.
    tasks : callable
        Function without arguments that returns the rows of the table `tasks` (one per detector of an exposure), as one
        table per partition. It is called twice.
    area : Area
        Area of the request. Pixels inside it, and not too close to its edge, are marked as interior.
    side : int
        Pixels along each side of a map.

    Returns
    -------
    list of Depth
        One map per channel and band, sorted by their names.

    Raises
    ------
    BadInput
        If there are no exposures of the sky, or they extend over more than 60 deg.

    Notes
    -----
    Only image types of the survey ("science", "deep", "self_calibration") are counted. Short exposures, up to half as
    long as the longest one of their band, are not counted.
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
    # Offsets of the map's pixels from its centre in arcsec on the tangent plane, along both x (west) and y (north).
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
    """Return the numbers of the exposures of a channel and band that exceed half of the longest exposure time."""
    band_exposures = exposures.filter(
        pc.and_(pc.equal(exposures["channel"], channel), pc.equal(exposures["band"], band))
    )
    is_long = pc.greater(band_exposures["exposure_time_s"], 0.5 * pc.max(band_exposures["exposure_time_s"]).as_py())
    return band_exposures.filter(is_long)["exposure_id"].combine_chunks()


def _centre(exposures: pa.Table) -> tuple[float, float]:
    x, y, z = pointing.basis(exposures["ra"].to_numpy(), exposures["dec"].to_numpy())[2].sum(axis=1)
    return float(np.degrees(np.arctan2(y, x)) % 360.0), float(np.degrees(np.arctan2(z, np.hypot(x, y))))


def _reach(tasks: pa.Table, exposures: pa.Table) -> float:
    """Return the largest distance from the boresight (deg) that circles around the detectors of `exposures` reach.

    `tasks` has one row per detector of an exposure, with the circle (ra, dec, radius in deg) that contains it. Rows of
    exposures that are not in `exposures` are ignored. The result is 0 if no row remains.
    """
    indices = pc.index_in(tasks["exposure_id"], exposures["exposure_id"].combine_chunks()).combine_chunks()
    matched_tasks, indices = tasks.filter(pc.is_valid(indices)), indices.drop_null()
    ra, dec = (exposures[name].take(indices).to_numpy() for name in ("ra", "dec"))
    distances = (
        sky.separation(matched_tasks["ra"].to_numpy(), matched_tasks["dec"].to_numpy(), ra, dec)
        + matched_tasks["radius"].to_numpy()
    )
    return float(np.max(distances, initial=0.0))


def summary_line(depth: Depth) -> str:
    """Return a line with the exposures of a band, and the fractions of the interior with at least 1 to 4 exposures."""
    shares = ", ".join(f">= {n}: {depth.share(n):.3f}" for n in range(1, 5))
    return f"{depth.channel:7} {depth.band:12} {depth.exposures:6,} exposures   fraction of the interior {shares}"


def draw_maps(depth_maps: Sequence[Depth], path: Path) -> None:
    """Draw the number of exposures as one map per channel and band into a PNG file `path`.

    North is up and east to the left. A red line encloses the interior of the request's area, unless the interior is
    empty or fills the map.
    """
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
        # Columns of the map run to the west, so that the axis of eastern offsets is reversed.
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
    """Return the area of the request for which a table of the plan (`exposures` or `tasks`) was made."""
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
    """Run the command: print a line per channel and band of a plan, and draw the maps if `--out` is given.

    Return the exit status.
    """
    parser = Parser(prog="python -m truesky.render.coverage", description=(__doc__ or "").splitlines()[0])
    parser.add_lake("folder of the lake, with a plan")
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
