"""Images of a lake for the web page: tiles of pixels at several resolutions, sky coordinates, and the drawn sources."""

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
from lake_schema.arrays import Array, Float, Int
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

# Number of grid nodes along each side of an image. The page gets sky coordinates at these nodes, and interpolates.
_GRID_NODES = 33
# Default of the largest number of sources that are returned for an image.
MAX_SOURCES = 4000
Json = dict[str, Any]


@dataclass(frozen=True)
class Picture:
    """An image file of one detector and exposure: a row of the table `products`, which lists all image files.

    Attributes
    ----------
    version : Version
        Version of the table `products` that lists the file.
    row : mapping
        Row of the file in the table, by column.
    cosmic_ray_file : str or None
        Path of the truth image with the cosmic rays of the same detector and exposure; None if it does not exist.
    request_tables : RequestTables
        All tables of the request (the simulation) to which the image belongs.
    """

    version: read.Version
    row: Mapping[str, Any]
    cosmic_ray_file: str | None
    request_tables: RequestTables

    @property
    def detector_key(self) -> tuple[str | None, int, str]:
        """Name of the request (or None), number of the exposure, and name of the detector.

        Together they identify one readout of a detector, of which there can be several image files.
        """
        return self.request_tables.request, self.row["exposure_id"], self.row["detector"]

    @cached_property
    def can_remove_cosmic_rays(self) -> bool:
        """True if cosmic rays can be removed: the image is a science image, and a truth image of them exists."""
        return self.row["content"] == "science" and self.cosmic_ray_file is not None

    def levels(self, without_cosmic_rays: bool = False) -> list[Array]:
        """Return the image at decreasing resolutions, each as a memory-mapped float32 array [ny, nx].

        Level 0 has the full resolution. Each further level contains means of 2 x 2 pixels of the one before, until the
        image has at most 512 x 512 pixels. Pixels are in electrons, except in images of saturation flags. If
        `without_cosmic_rays` is True, cosmic rays are removed if possible.
        """
        return self._cleaned_levels if without_cosmic_rays and self.can_remove_cosmic_rays else self._original_levels

    @cached_property
    def _original_levels(self) -> list[Array]:
        return self._make_levels("")

    @cached_property
    def _cleaned_levels(self) -> list[Array]:
        return self._make_levels(str(self.cosmic_ray_file))

    def _make_levels(self, cosmic_ray_file: str) -> list[Array]:
        """Return the image at decreasing resolutions, computed or from the cache; "" keeps the cosmic rays.

        Call this once per image, because the files are read completely to verify their checksums.
        """
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
        """Cards of the FITS header of the image: (keyword, value, comment)."""
        return read_back.frame(read_back.image_file(self.version, self.row["path"])).cards

    @cached_property
    def wcs(self) -> WCS:
        """World coordinate system from the header of the image."""
        return astrometry.from_cards(self.header_cards)

    def tile(self, level: int, row: int, column: int, without_cosmic_rays: bool = False) -> Array:
        """Return one tile of the image at one of its resolutions.

        Parameters
        ----------
        level : int
            Resolution: 0 is the full resolution, and each further level halves it.
        row, column : int
            Indices of the tile in this level; the first tile of a row or column has index 0.
        without_cosmic_rays : bool, optional
            Remove cosmic rays if a truth image of them exists.

        Returns
        -------
        float32 array, shape (ny, nx)
            Pixels in electrons (flags in an image of saturation), 512 x 512 or fewer at the edges.

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
    """Return all image files of the lake, in the order of the tables `products` of its requests.

    The index of a file in this list is the number by which the page refers to the image.
    """
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
    """Return the image with this number (its index in the list of `pictures`); raise BadInput if it does not exist."""
    images = pictures(lake)
    if not 0 <= number < len(images):
        raise BadInput(f"the lake has no image {number}; it has {len(images)}")
    return images[number]


def list_images(lake: LakeSession) -> list[Json]:
    """Return one dictionary per image for the menu of the page.

    Its keys are `number`, `is_mendable` (True if cosmic rays can be removed), `request` (name), and the columns of the
    table `products` except `mission`.
    """
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
    """Return the data that the page needs to show an image.

    Among them are its shape `nx` and `ny`, the shapes of its `levels` (resolutions), estimates of the `sky` level and
    the `noise` for the initial scale of brightness, a `grid` of sky coordinates, its `header`, and its `row` in the
    table `products`. BadInput is raised if there is no image with this number.
    """
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
    """Return tangent-plane coordinates at the nodes of a grid of pixels, from which the page interpolates.

    The keys are `ra`, `dec` (centre of the image, deg), `x`, `y` (columns and rows of the nodes, pixels, n values
    each), and `xi`, `eta` (coordinates to the east and north of the centre, deg, n * n values each, row by row). Unlike
    RA, such coordinates do not jump at 360 degrees.
    """
    x, y = np.linspace(-0.5, nx - 0.5, _GRID_NODES), np.linspace(-0.5, ny - 0.5, _GRID_NODES)
    (ra0,), (dec0,) = astrometry.sky_of_pixel(wcs, [(nx - 1) / 2], [(ny - 1) / 2])
    column, row = np.meshgrid(x, y)
    ra, dec = astrometry.sky_of_pixel(wcs, column.ravel(), row.ravel())
    xi, eta = to_tangent_plane(ra, dec, float(ra0), float(dec0))
    plane = {name: np.round(values, 12).tolist() for name, values in (("xi", xi), ("eta", eta))}
    return {"ra": float(ra0), "dec": float(dec0), "x": x.tolist(), "y": y.tolist(), **plane}


def to_tangent_plane(ra: Float, dec: Float, ra0: float, dec0: float) -> tuple[Float, Float]:
    """Project positions on the sky onto a tangent plane (gnomonic projection).

    Parameters
    ----------
    ra, dec : float array, shape (n,)
        Positions in degrees, less than 90 degrees from the tangent point; this is not checked.
    ra0, dec0 : float
        Tangent point, where the plane touches the sphere, in degrees.

    Returns
    -------
    east, north : float array, shape (n,)
        Coordinates in the plane relative to the tangent point, in degrees.
    """
    a, d, d0 = np.radians(ra - ra0), np.radians(dec), np.radians(dec0)
    depth = np.sin(d0) * np.sin(d) + np.cos(d0) * np.cos(d) * np.cos(a)
    east, north = np.cos(d) * np.sin(a), np.cos(d0) * np.sin(d) - np.sin(d0) * np.cos(d) * np.cos(a)
    return np.degrees(east / depth), np.degrees(north / depth)


def bright_sources(lake: LakeSession, number: int, max_sources: int = MAX_SOURCES) -> Json:
    """Return the brightest sources that were drawn on an image.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    number : int
        Number of the image, see `pictures`.
    max_sources : int, optional
        Largest number of sources to return.

    Returns
    -------
    dict
        `total` (number of sources on the image), and lists with one value per source: `id` (text), pixel coordinates
        `x` and `y`, `expected` (electrons expected in the exposure, on and off the detector), `drawn` (electrons drawn
        on the image) and `kind` (type of the source, such as "star"). The source with the most expected electrons comes
        first.

    Raises
    ------
    BadInput
        If there is no image with this number.
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
        "kind": kind_names(rows["id"].to_numpy()),
    }


# Names of the kinds (types) of sources, such as "star", by the code in the first bits of an identifier.
KIND_NAMES = {int(code): name for code, name in GALAXIES.column("kind").codes} | {5: "star", 6: "moving body"}


def kind_names(identifiers: Int) -> list[str]:
    """Return the type of each source, such as "star"; "changing source" for supernovae, nuclei and lensed images."""
    names = [KIND_NAMES.get(kind, str(kind)) for kind in ids.kind_from_id(identifiers).tolist()]
    changes = ids.is_transient(identifiers).tolist()
    return ["changing source" if change else name for name, change in zip(names, changes, strict=True)]


def failed_detectors(lake: LakeSession, request_tables: RequestTables) -> list[Json]:
    """Return one dictionary per detector of a request whose last attempt to render it failed.

    Its keys are the columns of `truesky.render.archive.failures`, such as `error`. The list is empty if no run has left
    a log, or if a log is damaged.
    """
    try:
        return [row for name in request_tables.names or [None] for row in archive.failures(lake.root, name).to_pylist()]
    except LakeError:
        return []


def is_north_up(lake: LakeSession, number: int) -> bool:
    """Return True if declination increases with the row number at the first pixel of an image.

    BadInput is raised if there is no image with this number.
    """
    image = picture(lake, number)
    _, dec = astrometry.sky_of_pixel(image.wcs, [0.0, 0.0], [0.0, 1.0])
    return bool(dec[1] > dec[0])


def images_at(lake: LakeSession, ra: float, dec: float) -> list[tuple[int, float, float]]:
    """Find the images that contain a position on the sky.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    ra, dec : float
        Position in degrees.

    Returns
    -------
    list of (int, float, float)
        Number of the image, and column and row of the position in it (0 is the centre of the first pixel). Empty if no
        image contains the position.
    """
    images = pictures(lake)
    regions = pa.table({"number": range(len(images)), "s_region": [str(image.row["s_region"]) for image in images]})
    matches = []
    # Test the footprints in the table first, so that only the files of images that may contain the position are opened.
    for number in archive.rows_at_place(regions, ra, dec)["number"].to_pylist() if images else []:
        image = images[number]
        (x,), (y,) = astrometry.pixel_of_sky(image.wcs, [ra], [dec])
        ny, nx = image.levels()[0].shape
        if -0.5 <= x <= nx - 0.5 and -0.5 <= y <= ny - 0.5:
            matches.append((number, float(x), float(y)))
    return matches
