"""Images of a lake for the page: pyramids of tiles, sky coordinates, and the sources on each image."""

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

# Number of grid nodes along each side of an image. Sky coordinates are given at nodes and interpolated between them.
_GRID_NODES = 33
MAX_SOURCES = 4000
Json = dict[str, Any]


@dataclass(frozen=True)
class Picture:
    """An image file of the table `products`.

    Attributes
    ----------
    version : Version
        Version of the table `products`.
    row : mapping
        Row of the file in the table.
    cosmic_ray_file : str or None
        Path of the image of cosmic rays of the same detector and exposure, if there is one.
    request_tables : RequestTables
        Tables of the request that the image belongs to.
    """

    version: read.Version
    row: Mapping[str, Any]
    cosmic_ray_file: str | None
    request_tables: RequestTables

    @property
    def detector_key(self) -> tuple[str | None, int, str]:
        """Request, number of the exposure, and detector; together they identify one read-out of a detector."""
        return self.request_tables.request, self.row["exposure_id"], self.row["detector"]

    @cached_property
    def can_remove_cosmic_rays(self) -> bool:
        """True if the cosmic rays of the image can be subtracted."""
        return self.row["content"] == "science" and self.cosmic_ray_file is not None

    def levels(self, without_cosmic_rays: bool = False) -> list[Array]:
        """Return the image pyramid: the pixels, then repeated means of 2 x 2 pixels until one tile holds the image.

        Each level is a memory-mapped float32 array [ny, nx].
        """
        return self._cleaned_levels if without_cosmic_rays and self.can_remove_cosmic_rays else self._original_levels

    @cached_property
    def _original_levels(self) -> list[Array]:
        return self._make_levels("")

    @cached_property
    def _cleaned_levels(self) -> list[Array]:
        return self._make_levels(str(self.cosmic_ray_file))

    def _make_levels(self, cosmic_ray_file: str) -> list[Array]:
        """Make or map the pyramid. The files are verified by checksum, which reads them completely, so do it once."""
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
        """FITS header of the image as (keyword, value, comment)."""
        return read_back.frame(self.version.sidecar_path(self.row["path"])).cards

    @cached_property
    def wcs(self) -> WCS:
        """World coordinate system from the header of the image."""
        return astrometry.from_cards(self.header_cards)

    def tile(self, level: int, row: int, column: int, without_cosmic_rays: bool = False) -> Array:
        """Return one tile of the pyramid.

        Parameters
        ----------
        level : int
            Level of the pyramid; 0 is the full resolution.
        row, column : int
            Indices of the tile in this level.
        without_cosmic_rays : bool, optional
            Subtract cosmic rays if their image exists.

        Returns
        -------
        float32 array
            Pixels in electrons, at most 512 x 512.

        Raises
        ------
        BadInput
            If the image has no such level or tile.
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
    """Return all image files in the order of the tables `products`. The page refers to a file by its index here."""
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
    """Return the image with this number; raise BadInput if it does not exist."""
    images = pictures(lake)
    if not 0 <= number < len(images):
        raise BadInput(f"the lake has no image {number}; it has {len(images)}")
    return images[number]


def list_images(lake: LakeSession) -> list[Json]:
    """Return one description per image for the menu of the page."""
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
    """Return the shape and levels of an image, sky and noise for its initial stretch, and a grid of sky coordinates."""
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
    """Return tangent-plane coordinates (deg, east and north of the image centre) at nodes of a grid of pixels.

    The keys are `ra`, `dec` (centre), `x`, `y` (pixels of the nodes, [n]), `xi` and `eta` (coordinates, [n, n]).
    Tangent-plane coordinates are smooth and, unlike RA, do not jump at 360 degrees.
    """
    x, y = np.linspace(-0.5, nx - 0.5, _GRID_NODES), np.linspace(-0.5, ny - 0.5, _GRID_NODES)
    (ra0,), (dec0,) = astrometry.sky_of_pixel(wcs, [(nx - 1) / 2], [(ny - 1) / 2])
    column, row = np.meshgrid(x, y)
    ra, dec = astrometry.sky_of_pixel(wcs, column.ravel(), row.ravel())
    xi, eta = to_tangent_plane(ra, dec, float(ra0), float(dec0))
    plane = {name: np.round(values, 12).tolist() for name, values in (("xi", xi), ("eta", eta))}
    return {"ra": float(ra0), "dec": float(dec0), "x": x.tolist(), "y": y.tolist(), **plane}


def to_tangent_plane(ra: Float, dec: Float, ra0: float, dec0: float) -> tuple[Float, Float]:
    """Project positions onto a tangent plane.

    Parameters
    ----------
    ra, dec : float array, shape (n,)
        Positions in degrees.
    ra0, dec0 : float
        Point where the plane touches the sphere, in degrees.

    Returns
    -------
    east, north : float array, shape (n,)
        Coordinates in the plane relative to this point, in degrees.
    """
    a, d, d0 = np.radians(ra - ra0), np.radians(dec), np.radians(dec0)
    depth = np.sin(d0) * np.sin(d) + np.cos(d0) * np.cos(d) * np.cos(a)
    east, north = np.cos(d) * np.sin(a), np.cos(d0) * np.sin(d) - np.sin(d0) * np.cos(d) * np.cos(a)
    return np.degrees(east / depth), np.degrees(north / depth)


def bright_sources(lake: LakeSession, number: int, max_sources: int = MAX_SOURCES) -> Json:
    """Return the brightest sources of an image.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    number : int
        Number of the image.
    max_sources : int, optional
        Largest number of sources.

    Returns
    -------
    dict
        `total` (number of sources on the image) and lists with one value per source: `id`, pixel `x` and `y`, electrons
        `expected` and `drawn`, and `kind`. The brightest source comes first.
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


# Names of the kinds of sources, by the code in their identifiers.
KIND_NAMES = {int(code): name for code, name in GALAXIES.column("kind").codes} | {5: "star", 6: "moving body"}


def _kind_names(rows: pa.Table) -> list[str]:
    return [KIND_NAMES.get(kind, str(kind)) for kind in ids.kind_from_id(rows["id"].to_numpy()).tolist()]


def failed_detectors(lake: LakeSession, request_tables: RequestTables) -> list[Json]:
    """Return rows of the detectors of a request whose last attempt failed; empty if there is no log of a run."""
    try:
        return [row for name in request_tables.names or [None] for row in archive.failures(lake.root, name).to_pylist()]
    except LakeError:
        return []


def is_north_up(lake: LakeSession, number: int) -> bool:
    """Return True if declination increases with the row number of an image."""
    image = picture(lake, number)
    _, dec = astrometry.sky_of_pixel(image.wcs, [0.0, 0.0], [0.0, 1.0])
    return bool(dec[1] > dec[0])


def images_at(lake: LakeSession, ra: float, dec: float) -> list[tuple[int, float, float]]:
    """Find the images that contain a position.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    ra, dec : float
        Position in degrees.

    Returns
    -------
    list of (int, float, float)
        Number of the image, column and row of the position; 0 is the centre of the first pixel.
    """
    images = pictures(lake)
    regions = pa.table({"number": range(len(images)), "s_region": [str(image.row["s_region"]) for image in images]})
    matches = []
    # Open only images whose footprint contains the position.
    for number in archive.rows_at_place(regions, ra, dec)["number"].to_pylist() if images else []:
        image = images[number]
        (x,), (y,) = astrometry.pixel_of_sky(image.wcs, [ra], [dec])
        ny, nx = image.levels()[0].shape
        if -0.5 <= x <= nx - 0.5 and -0.5 <= y <= ny - 0.5:
            matches.append((number, float(x), float(y)))
    return matches
