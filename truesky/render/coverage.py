"""How often each place of the sky is looked at: measured, and as a map.

    python -m truesky.render.coverage --lake LAKE [--name REQUEST] --out coverage.png

depths     of the lake's plan, each band over its area
picture    the same as maps
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
from truesky.render.planning import parts
from truesky.request.area import Area

_EXPOSURE = ("exposure_id", "channel", "band", "image_type", "exposure_time_s", "ra", "dec")
_TASK = ("exposure_id", "ra", "dec", "radius", "s_region")
# Places along a side of a map; the widest map, and how far inside an area its edge is no longer felt, deg.
_SIDE, _WIDEST, _INSIDE = 500, 60.0, 0.5
# Colours of a map, besides that of what nothing sees; more exposures than all but a few places have share the last.
_COLOURS, _FEW, _NOTHING = 8, 0.01, "#efece6"


@dataclass(frozen=True, slots=True)
class Depth:
    """How often a band's exposures see the places of a map.

    seen      : int[side, side], x to the west, y to the north;  extent : half a side, deg
    interior  : places more than 0.5 deg inside the request's area, or nearly so where it is small
    exposures : number of the band's
    """

    channel: str
    band: str
    exposures: int
    seen: Int
    interior: Bool
    extent: float

    def share(self, least: int) -> float:
        """Part of the interior that at least so many exposures see."""
        return float((self.seen[self.interior] >= least).mean()) if self.interior.any() else 0.0


def depths(exposures: pa.Table, tasks: Callable[[], Iterable[pa.Table]], area: Area, side: int = _SIDE) -> list[Depth]:
    """Of every channel and band that looks at the sky, long exposures alone.

    exposures : rows of the table;  tasks : rows of that table, a part after the other, whenever it is called
    area : of the request, where its interior lies;  side : pixels of the map
    """
    looks = exposures.filter(pc.is_in(exposures["image_type"], pa.array(SKY_TYPES)))
    if not looks.num_rows:
        raise BadInput("table exposures has none of the sky")
    ra0, dec0 = _centre(looks)
    far = float(np.max(sky.separation(looks["ra"].to_numpy(), looks["dec"].to_numpy(), ra0, dec0)))
    _refuse_wide(far)
    extent = far + max(_reach(some, looks) for some in tasks())
    _refuse_wide(extent)
    # Square on the tangent plane; x to the west.
    grid = np.tan(np.radians(extent)) * np.degrees(1.0) * 3600.0 * np.linspace(-1.0, 1.0, side)
    x, y = np.meshgrid(grid, grid)
    ra, dec = (a.ravel() for a in pointing.sky_of_plane(x, y, ra0, dec0, 0.0))
    inside = area.depth(ra, dec)
    interior = (inside > min(_INSIDE, 0.5 * float(inside.max()))).reshape(side, side)
    kinds = looks.group_by(["channel", "band"]).aggregate([]).to_pylist()
    long = {kind: _long(looks, *kind) for kind in sorted((row["channel"], row["band"]) for row in kinds)}
    seen = {kind: np.zeros(side * side, np.int64) for kind in long}
    for some in tasks():
        for kind, numbers in long.items():
            seen[kind] += footprints.counts(some.filter(pc.is_in(some["exposure_id"], numbers)), ra, dec)
    return [Depth(*kind, len(long[kind]), seen[kind].reshape(side, side), interior, extent) for kind in long]


def _refuse_wide(extent: float) -> None:
    if 2.0 * extent > _WIDEST:
        raise BadInput(f"the exposures lie {2 * extent:.0f} deg apart: a map shows {_WIDEST:g} deg at most")


def _long(exposures: pa.Table, channel: str, band: str) -> pa.Array:
    """Numbers of a band's long exposures."""
    own = exposures.filter(pc.and_(pc.equal(exposures["channel"], channel), pc.equal(exposures["band"], band)))
    is_long = pc.greater(own["exposure_time_s"], 0.5 * pc.max(own["exposure_time_s"]).as_py())
    return own.filter(is_long)["exposure_id"].combine_chunks()


def _centre(exposures: pa.Table) -> tuple[float, float]:
    x, y, z = pointing.basis(exposures["ra"].to_numpy(), exposures["dec"].to_numpy())[2].sum(axis=1)
    return float(np.degrees(np.arctan2(y, x)) % 360.0), float(np.degrees(np.arctan2(z, np.hypot(x, y))))


def _reach(tasks: pa.Table, exposures: pa.Table) -> float:
    """How far from their boresights the tasks of some exposures look, deg; 0 where there are none of them."""
    where = pc.index_in(tasks["exposure_id"], exposures["exposure_id"].combine_chunks()).combine_chunks()
    own, where = tasks.filter(pc.is_valid(where)), where.drop_null()
    ra, dec = (exposures[name].take(where).to_numpy() for name in ("ra", "dec"))
    far = sky.separation(own["ra"].to_numpy(), own["dec"].to_numpy(), ra, dec) + own["radius"].to_numpy()
    return float(np.max(far, initial=0.0))


def line(depth: Depth) -> str:
    """What a person reads of a band."""
    shares = ", ".join(f">= {n}: {depth.share(n):.3f}" for n in range(1, 5))
    return f"{depth.channel:7} {depth.band:12} {depth.exposures:6,} exposures   of the interior {shares}"


def picture(found: Sequence[Depth], path: Path) -> None:
    """A map a band, north up, east to the left: how many exposures see each place; the interior outlined."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import BoundaryNorm
    from matplotlib.figure import Figure

    columns = int(np.ceil(np.sqrt(len(found))))
    rows = -(-len(found) // columns)
    figure = Figure(figsize=(5.6 * columns, 5.2 * rows), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    colours = matplotlib.colormaps["viridis"].with_extremes(under=_NOTHING)
    for axes, depth in zip(np.ravel(figure.subplots(rows, columns, squeeze=False)), found, strict=False):
        seen = depth.seen[depth.seen > 0]
        most = int(np.quantile(seen, 1.0 - _FEW)) if seen.size else 1
        step = -(-most // _COLOURS)
        bounds = 0.5 + step * np.arange(-(-most // step) + 1)
        half = depth.extent
        # x of the map runs to the west.
        shown = axes.imshow(
            np.minimum(depth.seen, most), origin="lower", extent=(half, -half, -half, half), cmap=colours,
            interpolation="nearest", norm=BoundaryNorm(bounds, colours.N),
        )  # fmt: skip
        if depth.interior.any() and not depth.interior.all():
            axes.contour(
                depth.interior.astype(float), [0.5], extent=(half, -half, -half, half), colors="r", linewidths=1.2
            )
        axes.set_title(f"{depth.channel} {depth.band}: >= 3 over {100 * depth.share(3):.1f} %", fontsize=11)
        axes.set_xlabel("east [deg]")
        axes.set_ylabel("north [deg]")
        bar = figure.colorbar(shown, ax=axes, shrink=0.8, label="exposures")
        lowest = [round(b + 0.5) for b in bounds[:-1]]
        named = [f"{a}" if step == 1 else f"{a} - {a + step - 1}" for a in lowest]
        bar.set_ticks(list((bounds[:-1] + bounds[1:]) / 2), labels=[*named[:-1], f">= {lowest[-1]}"])
    for axes in figure.axes:
        if not axes.has_data():
            axes.set_visible(False)
    figure.savefig(path, metadata={"Software": None})


def area_of(version: read.Version) -> Area:
    """The area of the request that a plan was made for."""
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
    """Prints a line a band and draws the maps."""
    parser = argparse.ArgumentParser(
        prog="python -m truesky.render.coverage", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--lake", required=True, help="folder of the lake, with a plan")
    parser.add_argument("--name", help="of the request whose plan is meant, where the lake has several")
    parser.add_argument("--out", type=Path, help="PNG of the maps")
    options = parser.parse_args(argv)
    return command.status("coverage", lambda: _drawn(options.lake, options.name, options.out))


def _drawn(lake: str, name: str | None, out: Path | None) -> int:
    if out is not None:
        user_files.target(out, (".png",))
    root = layout.lake(lake)
    exposures, tasks = (read.version(root, table, request=name) for table in ("exposures", "tasks"))
    found = depths(exposures.rows(_EXPOSURE), partial(parts.each, tasks, _TASK), area_of(exposures))
    for depth in found:
        print(line(depth))
    if out is not None:
        picture(found, out)
        print(out)
    return 0


if __name__ == "__main__":
    command.leave(main)
