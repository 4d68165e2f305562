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
from truesky.page.answers import to_json_value
from truesky.page.lake_session import LakeSession, RequestTables
from truesky.render import archive
from truesky.render.camera import astrometry
from truesky.render.products import pyramids, read_back
from truesky.render.products.pyramids import TILE
from truesky.render.products.sidecar_files import truth_file

# Nodes along each side at which the place on the sky is given; between them it is interpolated.
_GRID_NODES = 33
MAX_SOURCES = 4000
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
    cosmic_ray_file: str | None
    request_tables: RequestTables

    @property
    def detector_key(self) -> tuple[str | None, int, str]:
        """Request, exposure and detector, which tell it from those of any other place and time."""
        return self.request_tables.request, self.row["exposure_id"], self.row["detector"]

    @cached_property
    def can_remove_cosmic_rays(self) -> bool:
        """Whether its cosmic rays can be taken away."""
        return self.row["content"] == "science" and self.cosmic_ray_file is not None

    def levels(self, without_cosmic_rays: bool = False) -> list[Array]:
        """Its pixels, and each time the means of 2 x 2 of them, until one tile holds all: float32 [ny, nx], mapped."""
        return self._cleaned_levels if without_cosmic_rays and self.can_remove_cosmic_rays else self._original_levels

    @cached_property
    def _original_levels(self) -> list[Array]:
        return self._make_levels("")

    @cached_property
    def _cleaned_levels(self) -> list[Array]:
        return self._make_levels(str(self.cosmic_ray_file))

    def _make_levels(self, cosmic_ray_file: str) -> list[Array]:
        """Compared with their checksums, which takes as long as reading all of them: once for all tiles."""
        checksums = (
            self.version.file_sha256(self.row["path"]),
            self.version.file_sha256(cosmic_ray_file) if cosmic_ray_file else "",
        )
        path, has_unit = self.version.sidecar_path(self.row["path"]), self.row["content"] != "saturation"
        return pyramids.levels(
            path, has_unit, self.version.sidecar_path(cosmic_ray_file) if cosmic_ray_file else None, checksums
        )

    @cached_property
    def header_cards(self) -> tuple[tuple[str, Any, str], ...]:
        """Its header."""
        return read_back.frame(self.version.sidecar_path(self.row["path"])).cards

    @cached_property
    def wcs(self) -> WCS:
        """Its world coordinates, which stand in the header of every file of a detector."""
        return astrometry.from_cards(self.header_cards)

    def tile(self, level: int, row: int, column: int, without_cosmic_rays: bool = False) -> Array:
        """float32 [<= 512, <= 512] electrons.

        level : of the pyramid;  row, column : of the tile there;  mended : without cosmic rays
        """
        levels = self.levels(without_cosmic_rays)
        if not 0 <= level < len(levels):
            raise BadInput(f"level = {level} is outside [0, {len(levels) - 1}]")
        tile = levels[level][row * TILE : (row + 1) * TILE, column * TILE : (column + 1) * TILE]
        if row < 0 or column < 0 or not tile.size:
            raise BadInput(f"the image has no tile {row}, {column} at level {level}")
        return tile


@lru_cache(maxsize=4)
def pictures(lake: LakeSession) -> list[Picture]:
    """Every file of the products, in the order of their table: a file goes by its number here, never by its path."""
    images = []
    for request_tables in lake.observed_requests:
        rows = request_tables.rows("products")
        cosmic_ray_files = {_exposure_and_detector(row): row["path"] for row in rows if row["content"] == "cosmic_rays"}
        images += [
            Picture(
                request_tables.versions["products"],
                row,
                cosmic_ray_files.get(_exposure_and_detector(row)),
                request_tables,
            )
            for row in rows
        ]
    return images


def _exposure_and_detector(row: Mapping[str, Any]) -> tuple[int, str]:
    return row["exposure_id"], row["detector"]


def picture(lake: LakeSession, number: int) -> Picture:
    """One of them.  Errors: BadInput where the lake has none of that number"""
    images = pictures(lake)
    if not 0 <= number < len(images):
        raise BadInput(f"the lake has no image {number}; it has {len(images)}")
    return images[number]


def list_images(lake: LakeSession) -> list[Json]:
    """All of them, as a menu wants them."""
    return [
        {
            "number": number,
            "is_mendable": image.can_remove_cosmic_rays,
            "request": image.request_tables.request,
            **{k: to_json_value(v) for k, v in image.row.items() if k != "mission"},
        }
        for number, image in enumerate(pictures(lake))
    ]


def describe_image(lake: LakeSession, number: int) -> Json:
    """Shape, levels, sky and noise for a first stretch, and places on the sky at nodes of a grid."""
    image = picture(lake, number)
    levels = image.levels()
    ny, nx = levels[0].shape
    smallest = levels[-1]
    finite = smallest[np.isfinite(smallest)]
    sky_level = float(np.median(finite)) if finite.size else 0.0
    pixels = levels[0][:: max(ny // 512, 1), :: max(nx // 512, 1)]
    residuals = sky_level - pixels[np.isfinite(pixels) & (pixels < sky_level)]
    noise = float(1.4826 * np.median(residuals)) if residuals.size else 0.0
    maximum = float(np.max(finite)) if finite.size else 1.0
    header = {key: to_json_value(value) for key, value, _ in image.header_cards}
    return {
        "number": number, "request": image.request_tables.request, "nx": nx, "ny": ny, "tile": TILE,
        "levels": [[level.shape[1], level.shape[0]] for level in levels],
        "sky": sky_level, "noise": noise if noise > 0 else max(abs(maximum) * 1e-4, 1e-6), "top": maximum,
        "unit": "electron" if image.row["content"] != "saturation" else "",
        "grid": _grid(image.wcs, nx, ny), "is_mendable": image.can_remove_cosmic_rays,
        "row": {key: to_json_value(value) for key, value in image.row.items()}, "header": header,
        "made_of": image.version.manifest["facts"].get("inputs", {}),
    }  # fmt: skip


def _grid(wcs: WCS, nx: int, ny: int) -> Json:
    """Tangent-plane coordinates (east, north) deg about the image's centre, at nodes: x[n], y[n], xi[n, n], eta[n, n].

    In the tangent plane a distortion is smooth, and RA has no seam.
    """
    x, y = np.linspace(-0.5, nx - 0.5, _GRID_NODES), np.linspace(-0.5, ny - 0.5, _GRID_NODES)
    (ra0,), (dec0,) = astrometry.sky_of_pixel(wcs, [(nx - 1) / 2], [(ny - 1) / 2])
    column, row = np.meshgrid(x, y)
    ra, dec = astrometry.sky_of_pixel(wcs, column.ravel(), row.ravel())
    xi, eta = to_tangent_plane(ra, dec, float(ra0), float(dec0))
    plane = {name: np.round(values, 12).tolist() for name, values in (("xi", xi), ("eta", eta))}
    return {"ra": float(ra0), "dec": float(dec0), "x": x.tolist(), "y": y.tolist(), **plane}


def to_tangent_plane(ra: Float, dec: Float, ra0: float, dec0: float) -> tuple[Float, Float]:
    """Places on a tangent plane: east and north of where it touches, deg.

    ra, dec : [n] deg;  ra0, dec0 : where it touches the sphere, deg
    """
    a, d, d0 = np.radians(ra - ra0), np.radians(dec), np.radians(dec0)
    depth = np.sin(d0) * np.sin(d) + np.cos(d0) * np.cos(d) * np.cos(a)
    east, north = np.cos(d) * np.sin(a), np.cos(d0) * np.sin(d) - np.sin(d0) * np.cos(d) * np.cos(a)
    return np.degrees(east / depth), np.degrees(north / depth)


def bright_sources(lake: LakeSession, number: int, max_sources: int = MAX_SOURCES) -> Json:
    """The brightest sources of an image: pixel, electrons, kind and identifier.

    number : of the image;  most : so many at most
    """
    image = picture(lake, number)
    exposure, detector = image.row["exposure_id"], image.row["detector"]
    rows = image.version.read_sidecar(truth_file(exposure, detector))
    order = pc.sort_indices(rows, [("expected", "descending")]).slice(0, max_sources)
    rows = rows.take(order)
    return {
        "total": image.row["sources"],
        "id": [str(value) for value in rows["id"].to_pylist()],
        **{name: np.round(rows[name].to_numpy(), 3).tolist() for name in ("x", "y", "expected", "drawn")},
        "kind": _kind_names(rows),
    }


# What the kind in an identifier stands for.
KIND_NAMES = {int(code): name for code, name in GALAXIES.column("kind").codes} | {5: "star", 6: "moving body"}


def _kind_names(rows: pa.Table) -> list[str]:
    return [KIND_NAMES.get(kind, str(kind)) for kind in ids.kind_from_id(rows["id"].to_numpy()).tolist()]


def failed_detectors(lake: LakeSession, request_tables: RequestTables) -> list[Json]:
    """Detectors of a request whose last attempt failed, none where no run has left a log."""
    try:
        return [row for name in request_tables.names or [None] for row in archive.failures(lake.root, name).to_pylist()]
    except LakeError:
        return []


def is_north_up(lake: LakeSession, number: int) -> bool:
    """Whether declination grows with the rows of an image."""
    image = picture(lake, number)
    _, dec = astrometry.sky_of_pixel(image.wcs, [0.0, 0.0], [0.0, 1.0])
    return bool(dec[1] > dec[0])


def images_at(lake: LakeSession, ra: float, dec: float) -> list[tuple[int, float, float]]:
    """Images that hold a place: number, column and row, 0 = centre of the first pixel."""
    images = pictures(lake)
    regions = pa.table({"number": range(len(images)), "s_region": [str(image.row["s_region"]) for image in images]})
    matches = []
    # Only what may hold it is opened.
    for number in archive.rows_at_place(regions, ra, dec)["number"].to_pylist() if images else []:
        image = images[number]
        (x,), (y,) = astrometry.pixel_of_sky(image.system, [ra], [dec])
        ny, nx = image.levels()[0].shape
        if -0.5 <= x <= nx - 0.5 and -0.5 <= y <= ny - 0.5:
            matches.append((number, float(x), float(y)))
    return matches
