"""Define the area of the sky that a request (a user's TOML file) covers, and read it from the request.

An area can list the HEALPix cells that it touches and test whether positions are inside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lake_schema import sky
from lake_schema.arrays import Bool, Float
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from lake_schema.sky.ecliptic import ecliptic, tile_corners, tile_count
from truesky.numerics import matrices
from truesky.request.toml_values import Toml, as_table, boolean, checked_number, integer, number, number_pair

_FORMS = ("polygon", "cone", "box", "tile", "patches", "wide")
# The wide survey omits positions within these angles (deg) of the Galactic and ecliptic planes. The values are adopted.
# They leave about 15 000 deg2, as in Serrano et al. 2024, where the region follows maps of stars, dust and zodiacal
# light.
_GALACTIC_MIN, _ECLIPTIC_MIN = 30.0, 15.0
# Largest number of vertices of a polygon, and of circles of an area.
_MAX_VERTICES, _MAX_PATCHES = 1000, 1000
# Name, smallest and largest value (deg) of a coordinate.
_RA, _DEC = ("ra", -360.0, 360.0), ("dec", -90.0, 90.0)


@dataclass(frozen=True, slots=True)
class Area:
    """A convex spherical polygon, a box, a circle, several circles, or the sky of the wide survey.

    Only the attributes of one shape are set; the others have their defaults.

    Attributes
    ----------
    vertices : tuple of (float, float)
        Right ascension and declination of the vertices of a polygon in degrees.
    box : (float, float, float, float), optional
        Right ascension of the west and east limits, and declination of the south and north limits, in degrees. East is
        smaller than west if the box crosses right ascension 0.
    ra, dec, radius : float
        Centre and radius of a circle in degrees, used if no other shape is given.
    patches : tuple of (float, float, float)
        Right ascension, declination and radius of several circles in degrees.
    wide : bool
        True for the sky of the wide survey.
    """

    vertices: tuple[tuple[float, float], ...] = ()
    box: tuple[float, float, float, float] | None = None
    ra: float = 0.0
    dec: float = 0.0
    radius: float = 0.0
    patches: tuple[tuple[float, float, float], ...] = ()
    wide: bool = False

    def cells(self, order: int = GENERATION_ORDER) -> list[int]:
        """Return the indices (nested scheme) of the HEALPix cells of `order` that the area touches, ascending.

        Some cells just outside the edge of the area may be included.
        """
        if self.wide:
            all_cells = np.arange(12 << (2 * order))
            touched = self.contains(*sky.cell_centres(order, all_cells), 2 * sky.cell_radius(order))
            return [int(cell) for cell in all_cells[touched]]
        if self.patches:
            patch_cells = [sky.cells_in_cone(*patch, order) for patch in self.patches]
            return [int(cell) for cell in np.unique(np.concatenate(patch_cells))]
        if self.box is not None:
            return [int(cell) for cell in sky.cells_in_box(*self.box, order)]
        if self.vertices:
            return [int(cell) for cell in sky.cells_in_polygon(self.vertices, order)]
        return [int(cell) for cell in sky.cells_in_cone(self.ra, self.dec, self.radius, order)]

    def contains(self, ra: npt.ArrayLike, dec: npt.ArrayLike, margin: float = 0.0) -> Bool:
        """Return True for positions in the area, or outside it by at most `margin`.

        Parameters
        ----------
        ra, dec : float array, shape (n,)
            Positions in degrees.
        margin : float, optional
            Largest distance from the area in degrees. A negative margin excludes positions near the edge.

        Returns
        -------
        bool array, shape (n,)
            True for positions in the area or at most `margin` outside. Opposite a corner of a polygon or box, some
            positions that are farther away are accepted; see `depth`.
        """
        return np.asarray(self.depth(ra, dec) >= -margin)

    def depth(self, ra: npt.ArrayLike, dec: npt.ArrayLike) -> Float:
        """Return the distance from each position to the edge of the area in degrees, negative outside the area.

        Parameters
        ----------
        ra, dec : float array, shape (n,)
            Positions in degrees.

        Returns
        -------
        float array, shape (n,)
            Distance to the edge in degrees.

        Notes
        -----
        For positions outside a polygon, a box or the sky of the wide survey, opposite a corner, the distance is larger
        than the absolute value of the result. Where several circles overlap, the result is the distance to the edge of
        one of them, which may be inside another. Distances to the west and east sides of a box are measured along the
        parallel, which is longer than a great circle.
        """
        lon, lat = np.asarray(ra, float), np.asarray(dec, float)
        if self.wide:
            b, beta = sky.galactic(lon, lat)[1], ecliptic(lon, lat)[1]
            return np.asarray(np.minimum(np.abs(b) - _GALACTIC_MIN, np.abs(beta) - _ECLIPTIC_MIN))
        if self.patches:
            distance = [radius - sky.separation(lon, lat, x, y) for x, y, radius in self.patches]
            return np.asarray(np.max(distance, axis=0))
        if self.box is not None:
            west, east, south, north = self.box
            middle, half = west + 0.5 * ((east - west) % 360.0), 0.5 * ((east - west) % 360.0)
            across = np.abs((lon - middle + 180.0) % 360.0 - 180.0)
            along = (half - across) * np.cos(np.radians(lat))
            return np.asarray(np.minimum(along, np.minimum(lat - south, north - lat)))
        if self.vertices:
            return _polygon_depth(self.vertices, lon, lat)
        return self.radius - sky.separation(lon, lat, self.ra, self.dec)

    def bounding_circle(self) -> tuple[float, float, float]:
        """Return right ascension, declination and radius (degrees) of a circle that contains the area.

        The circle is not the smallest one. It is the whole sky for the wide survey.
        """
        if self.wide:
            return 0.0, 0.0, 180.0
        corners = np.array([patch[:2] for patch in self.patches] or self.vertices or _corners_of(self.box))
        if not corners.size:
            return self.ra, self.dec, self.radius
        x, y, z = sky.unit_vectors(corners[:, 0], corners[:, 1]).sum(0)
        ra, dec = float(np.degrees(np.arctan2(y, x)) % 360.0), float(np.degrees(np.arctan2(z, np.hypot(x, y))))
        reach = sky.separation(corners[:, 0], corners[:, 1], ra, dec)
        return ra, dec, min(float((reach + np.array([p[2] for p in self.patches] or [0.0])).max()) * 1.05, 180.0)


def _corners_of(box: tuple[float, float, float, float] | None) -> list[tuple[float, float]]:
    if box is None:
        return []
    west, east, south, north = box
    lon = west + np.linspace(0.0, (east - west) % 360.0, 9)
    return [(float(x) % 360.0, y) for x in lon for y in (south, north)]


def _polygon_depth(vertices: Sequence[tuple[float, float]], ra: Float, dec: Float) -> Float:
    corners = sky.unit_vectors(*np.array(vertices).T)
    sides = np.cross(corners, np.roll(corners, -1, 0))
    sides /= np.sqrt(np.sum(sides**2, axis=1, keepdims=True))
    # Let all normals point into the polygon, whose vertices may be in clockwise or counterclockwise order.
    sides *= np.sign(matrices.matmul(sides[0], corners[2]))
    x, y = np.radians(ra), np.radians(dec)
    place = np.stack([np.cos(y) * np.cos(x), np.cos(y) * np.sin(x), np.sin(y)])
    depth = np.degrees(np.arcsin(np.clip(matrices.matmul(sides, place.reshape(3, -1)), -1.0, 1.0))).min(axis=0)
    return np.asarray(depth.reshape(np.shape(ra)))


def parse(table: Toml, path: str = "area") -> Area:
    """Read the section `area` of a request.

    Parameters
    ----------
    table : Toml
        The section, with exactly one of the keys "polygon", "cone", "box", "tile", "patches" and "wide".
    path : str, optional
        Name of the section, for error messages.

    Returns
    -------
    Area
        The area.

    Raises
    ------
    BadInput
        If the section has another number of keys, an unknown key or a wrong value. The message names the key.
    OutOfRange
        If a number is out of range.
    """
    table = as_table(table, path, set(_FORMS))
    if len(table) != 1:
        raise BadInput(f"{path} must have exactly one of {', '.join(_FORMS)}")
    readers = {
        "polygon": lambda: _polygon(table["polygon"], f"{path}.polygon"),
        "cone": lambda: _cone(table["cone"], f"{path}.cone"),
        "box": lambda: _box(table["box"], f"{path}.box"),
        "tile": lambda: _tile(integer(table, f"{path}.tile", 0, tile_count() - 1)),
        "patches": lambda: _patches(table["patches"], f"{path}.patches"),
        "wide": lambda: _wide(boolean(table, f"{path}.wide", True), path),
    }
    return readers[next(iter(table))]()


def _cone(value: object, path: str) -> Area:
    cone = as_table(value, path, {"ra", "dec", "radius"})
    ra = number(cone, f"{path}.ra", -360.0, 360.0) % 360.0
    return Area(ra=ra, dec=number(cone, f"{path}.dec", -90.0, 90.0), radius=number(cone, f"{path}.radius", 0.0, 180.0))


def _box(value: object, path: str) -> Area:
    box = as_table(value, path, {"ra", "dec"})
    west, east = number_pair(box, f"{path}.ra", -360.0, 720.0)
    south, north = number_pair(box, f"{path}.dec", -90.0, 90.0)
    # A box may cross right ascension 0: the range [350, 10] has a width of 20 deg.
    width = east - west + (360.0 if east < west else 0.0)
    if not 0.0 < width < 180.0:
        raise BadInput(f"{path}.ra = [{west}, {east}]: the second must be east of the first by less than 180 deg")
    if not north > south:
        raise BadInput(f"{path}.dec = [{south}, {north}]: the second must be larger")
    return Area(box=(west % 360.0, east % 360.0, south, north))


def _polygon(value: object, path: str) -> Area:
    vertices = tuple((ra, dec) for ra, dec in _coordinate_lists(value, path, 3, _MAX_VERTICES, _RA, _DEC))
    try:
        sky.cells_in_polygon(vertices, 0)
    except BadInput as error:
        raise BadInput(f"{path}: {error}") from None
    return Area(vertices=vertices)


def _tile(tile: int) -> Area:
    return Area(vertices=tuple((float(ra), float(dec)) for ra, dec in tile_corners(tile)))


def _patches(value: object, path: str) -> Area:
    circles = _coordinate_lists(value, path, 1, _MAX_PATCHES, _RA, _DEC, ("radius", 0.0, 90.0))
    return Area(patches=tuple((ra, dec, radius) for ra, dec, radius in circles))


def _coordinate_lists(
    value: object, path: str, min_count: int, max_count: int, *bounds: tuple[str, float, float]
) -> list[list[float]]:
    """Read `min_count` to `max_count` lists of numbers in degrees, of which the first is a right ascension.

    `bounds` has the name, smallest and largest value of each number in a list. Right ascensions are converted to 0 to
    360. Raises BadInput, which names `path`, if the value is not such a list.
    """
    form = f"[{', '.join(name for name, _, _ in bounds)}]"
    if not isinstance(value, list) or not min_count <= len(value) <= max_count:
        raise BadInput(f"{path} must be a list of {min_count} to {max_count} {form}")
    places = []
    for i, place in enumerate(value):
        if not isinstance(place, list) or len(place) != len(bounds):
            raise BadInput(f"{path}[{i}] must be {form}")
        numbers = zip(place, bounds, strict=True)
        ra, *rest = (checked_number(number, f"{path}[{i}].{name}", lo, hi) for number, (name, lo, hi) in numbers)
        places.append([ra % 360.0, *rest])
    return places


def _wide(enabled: bool, path: str) -> Area:
    if not enabled:
        raise BadInput(f"{path}.wide must be true, got false: select another area or delete the key")
    return Area(wide=True)
