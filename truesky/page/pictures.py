"""Images of a lake: pyramids of tiles, their places on the sky, the sources in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from astropy.wcs import WCS

from lake_schema import ids
from lake_schema.arrays import Array, Float
from lake_schema.errors import BadInput, LakeError
from lake_schema.store import read
from lake_schema.tables.galaxies import GALAXIES
from truesky.page.answers import plain
from truesky.page.opened import Lake, Requested
from truesky.render import archive
from truesky.render.camera import astrometry
from truesky.render.products import pyramids, read_back
from truesky.render.products.beside import truth_file
from truesky.render.products.pyramids import TILE

# Nodes along each side at which the place on the sky is given; between them it is interpolated.
_NODES = 33
MOST_SOURCES = 4000
Json = dict[str, Any]


@dataclass(frozen=True)
class Picture:
    """A file of the table `products`.

    version : of the table;  row : of the file
    hits    : the file of its cosmic rays' truth, where there is one
    own     : the tables of the request that has it
    """

    version: read.Version
    row: Mapping[str, Any]
    hits: str | None
    own: Requested

    @property
    def place(self) -> tuple[str | None, int, str]:
        """Request, exposure and detector, which tell it from those of any other place and time."""
        return self.own.request, self.row["exposure_id"], self.row["detector"]

    @cached_property
    def is_mendable(self) -> bool:
        """Whether its cosmic rays can be taken away."""
        return self.row["content"] == "science" and self.hits is not None

    def levels(self, mended: bool = False) -> list[Array]:
        """Its pixels, and each time the means of 2 x 2 of them, until one tile holds all: float32 [ny, nx], mapped."""
        return self._mended if mended and self.is_mendable else self._as_it_is

    @cached_property
    def _as_it_is(self) -> list[Array]:
        return self._levels("")

    @cached_property
    def _mended(self) -> list[Array]:
        return self._levels(str(self.hits))

    def _levels(self, hits: str) -> list[Array]:
        """Compared with their checksums, which takes as long as reading all of them: once for all tiles."""
        contents = self.version.sha256(self.row["path"]), self.version.sha256(hits) if hits else ""
        path, has_unit = self.version.file(self.row["path"]), self.row["content"] != "saturation"
        return pyramids.levels(path, has_unit, self.version.file(hits) if hits else None, contents)

    @cached_property
    def cards(self) -> tuple[tuple[str, Any, str], ...]:
        """Its header."""
        return read_back.frame(self.version.file(self.row["path"])).cards

    @cached_property
    def system(self) -> WCS:
        """Its world coordinates, which stand in the header of every file of a detector."""
        return astrometry.from_cards(self.cards)

    def tile(self, level: int, row: int, column: int, mended: bool = False) -> Array:
        """float32 [<= 512, <= 512] electrons.

        level : of the pyramid;  row, column : of the tile there;  mended : without cosmic rays
        """
        levels = self.levels(mended)
        if not 0 <= level < len(levels):
            raise BadInput(f"level = {level} is outside [0, {len(levels) - 1}]")
        found = levels[level][row * TILE : (row + 1) * TILE, column * TILE : (column + 1) * TILE]
        if row < 0 or column < 0 or not found.size:
            raise BadInput(f"the image has no tile {row}, {column} at level {level}")
        return found


@lru_cache(maxsize=4)
def pictures(lake: Lake) -> list[Picture]:
    """Every file of the products, in the order of their table: a file goes by its number here, never by its path."""
    found = []
    for own in lake.observed:
        rows = own.rows("products")
        hits = {_frame(row): row["path"] for row in rows if row["content"] == "cosmic_rays"}
        found += [Picture(own.versions["products"], row, hits.get(_frame(row)), own) for row in rows]
    return found


def _frame(row: Mapping[str, Any]) -> tuple[int, str]:
    return row["exposure_id"], row["detector"]


def picture(lake: Lake, number: int) -> Picture:
    """One of them.  Errors: BadInput where the lake has none of that number"""
    known = pictures(lake)
    if not 0 <= number < len(known):
        raise BadInput(f"the lake has no image {number}; it has {len(known)}")
    return known[number]


def listed(lake: Lake) -> list[Json]:
    """All of them, as a menu wants them."""
    return [
        {
            "number": number,
            "is_mendable": one.is_mendable,
            "request": one.own.request,
            **{k: plain(v) for k, v in one.row.items() if k != "mission"},
        }
        for number, one in enumerate(pictures(lake))
    ]


def described(lake: Lake, number: int) -> Json:
    """Shape, levels, sky and noise for a first stretch, and places on the sky at nodes of a grid."""
    one = picture(lake, number)
    levels = one.levels()
    ny, nx = levels[0].shape
    small = levels[-1]
    finite = small[np.isfinite(small)]
    sky_level = float(np.median(finite)) if finite.size else 0.0
    pixels = levels[0][:: max(ny // 512, 1), :: max(nx // 512, 1)]
    below = sky_level - pixels[np.isfinite(pixels) & (pixels < sky_level)]
    noise = float(1.4826 * np.median(below)) if below.size else 0.0
    top = float(np.max(finite)) if finite.size else 1.0
    header = {key: plain(value) for key, value, _ in one.cards}
    return {
        "number": number, "request": one.own.request, "nx": nx, "ny": ny, "tile": TILE,
        "levels": [[level.shape[1], level.shape[0]] for level in levels],
        "sky": sky_level, "noise": noise if noise > 0 else max(abs(top) * 1e-4, 1e-6), "top": top,
        "unit": "electron" if one.row["content"] != "saturation" else "",
        "grid": _grid(one.system, nx, ny), "is_mendable": one.is_mendable,
        "row": {key: plain(value) for key, value in one.row.items()}, "header": header,
        "made_of": one.version.manifest["facts"].get("inputs", {}),
    }  # fmt: skip


def _grid(system: WCS, nx: int, ny: int) -> Json:
    """Tangent-plane coordinates (east, north) deg about the image's centre, at nodes: x[n], y[n], xi[n, n], eta[n, n].

    In the tangent plane a distortion is smooth, and RA has no seam.
    """
    x, y = np.linspace(-0.5, nx - 0.5, _NODES), np.linspace(-0.5, ny - 0.5, _NODES)
    (ra0,), (dec0,) = astrometry.sky_of_pixel(system, [(nx - 1) / 2], [(ny - 1) / 2])
    column, row = np.meshgrid(x, y)
    ra, dec = astrometry.sky_of_pixel(system, column.ravel(), row.ravel())
    xi, eta = tangent(ra, dec, float(ra0), float(dec0))
    plane = {name: np.round(values, 12).tolist() for name, values in (("xi", xi), ("eta", eta))}
    return {"ra": float(ra0), "dec": float(dec0), "x": x.tolist(), "y": y.tolist(), **plane}


def tangent(ra: Float, dec: Float, ra0: float, dec0: float) -> tuple[Float, Float]:
    """Places on a tangent plane: east and north of where it touches, deg.

    ra, dec : [n] deg;  ra0, dec0 : where it touches the sphere, deg
    """
    a, d, d0 = np.radians(ra - ra0), np.radians(dec), np.radians(dec0)
    depth = np.sin(d0) * np.sin(d) + np.cos(d0) * np.cos(d) * np.cos(a)
    east, north = np.cos(d) * np.sin(a), np.cos(d0) * np.sin(d) - np.sin(d0) * np.cos(d) * np.cos(a)
    return np.degrees(east / depth), np.degrees(north / depth)


def truth(lake: Lake, number: int, most: int = MOST_SOURCES) -> Json:
    """The brightest sources of an image: pixel, electrons, kind and identifier.

    number : of the image;  most : so many at most
    """
    one = picture(lake, number)
    exposure, detector = one.row["exposure_id"], one.row["detector"]
    rows = one.version.beside(truth_file(exposure, detector))
    order = pc.sort_indices(rows, [("expected", "descending")]).slice(0, most)
    rows = rows.take(order)
    return {
        "total": one.row["sources"],
        "id": [str(value) for value in rows["id"].to_pylist()],
        **{name: np.round(rows[name].to_numpy(), 3).tolist() for name in ("x", "y", "expected", "drawn")},
        "kind": _kinds(rows),
    }


# What the kind in an identifier stands for.
KINDS = {int(code): name for code, name in GALAXIES.column("kind").codes} | {5: "star", 6: "moving body"}


def _kinds(rows: pa.Table) -> list[str]:
    return [KINDS.get(kind, str(kind)) for kind in ids.kind_of(rows["id"].to_numpy()).tolist()]


def failures(lake: Lake, own: Requested) -> list[Json]:
    """Detectors of a request whose last attempt failed, none where no run has left a log."""
    try:
        return [row for name in own.names or [None] for row in archive.failures(lake.root, name).to_pylist()]
    except LakeError:
        return []


def is_north_up(lake: Lake, number: int) -> bool:
    """Whether declination grows with the rows of an image."""
    one = picture(lake, number)
    _, dec = astrometry.sky_of_pixel(one.system, [0.0, 0.0], [0.0, 1.0])
    return bool(dec[1] > dec[0])


def covering(lake: Lake, ra: float, dec: float) -> list[tuple[int, float, float]]:
    """Images that hold a place: number, column and row, 0 = centre of the first pixel."""
    known = pictures(lake)
    regions = pa.table({"number": range(len(known)), "s_region": [str(one.row["s_region"]) for one in known]})
    found = []
    # Only what may hold it is opened.
    for number in archive.covering(regions, ra, dec)["number"].to_pylist() if known else []:
        one = known[number]
        (x,), (y,) = astrometry.pixel_of_sky(one.system, [ra], [dec])
        ny, nx = one.levels()[0].shape
        if -0.5 <= x <= nx - 0.5 and -0.5 <= y <= ny - 0.5:
            found.append((number, float(x), float(y)))
    return found
