"""Define the area of the sky that a request (a user's TOML file) covers, and read it from the request.

An area can list the HEALPix cells that it touches and test whether positions are inside.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lake_schema import sky
from lake_schema.arrays import Bool, Float
from lake_schema.errors import BadInput, Mistakes
from lake_schema.ids import GENERATION_ORDER
from lake_schema.sky.ecliptic import ecliptic, tile_corners, tile_count
from truesky.numerics import matrices
from truesky.request import sky_notation
from truesky.request.sky_notation import DEC_LIMITS, RA_LIMITS
from truesky.request.toml_values import (
    Toml,
    as_table,
    boolean,
    check_keys,
    checked_number,
    integer,
    number,
    quote_value,
    required_value,
)

_FORMS = ("polygon", "cone", "box", "tile", "patches", "wide")
# The wide survey omits positions within these angles (deg) of the Galactic and ecliptic planes. The values are adopted.
# They leave about 15 000 deg2, as in Serrano et al. 2024, where the region follows maps of stars, dust and zodiacal
# light.
GALACTIC_MIN, ECLIPTIC_MIN = 30.0, 15.0
_WIDE_SQUARE_DEGREES = 15_000.0
# Questions about keys that an area does not have.
_PLACES = {"circle": "did you mean cone = {{ {} }}?", "vertices": "did you mean polygon?"}
_CONE_KEYS = ("ra", "dec", "radius")
# Largest number of vertices of a polygon, and of circles of an area.
_MAX_VERTICES, _MAX_PATCHES = 1000, 1000
# Limits of right ascensions of a box in degrees, which may begin before 0 or end after 360.
_BOX_RA_LIMITS = (-360.0, 720.0)
# Example of each form of an area, for error messages.
_EXAMPLES = "cone = { ra = 150.1, dec = 2.2, radius = 0.5 } or box = { ra = [150, 151], dec = [2, 3] } (deg)"


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
            return np.asarray(np.minimum(np.abs(b) - GALACTIC_MIN, np.abs(beta) - ECLIPTIC_MIN))
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

    def describe(self) -> str:
        """Return a description of the area for error messages, such as "the circle of 0.2 deg at ra 5, dec 9"."""
        if self.wide:
            return "the sky of the wide survey"
        if self.patches:
            ra, dec, radius = self.patches[0]
            rest = f" and {len(self.patches) - 1} more" if len(self.patches) > 1 else ""
            return f"the circle of {radius:g} deg at ra {ra:g}, dec {dec:g}{rest}"
        if self.box is not None:
            west, east, south, north = self.box
            return f"the box of ra {west:g} to {east:g} and dec {south:g} to {north:g}"
        if self.vertices:
            ra, dec, radius = self.bounding_circle()
            return f"a polygon within {radius:.4g} deg of ra {ra:g}, dec {dec:g}"
        return f"the circle of {self.radius:g} deg at ra {self.ra:g}, dec {self.dec:g}"

    def square_degrees(self) -> float:
        """Return the size of the area in square degrees; circles that overlap count twice.

        It is rounded for the sky of the wide survey. The cells that the area touches are larger together.
        """
        if self.wide:
            return _WIDE_SQUARE_DEGREES
        if self.box is not None:
            west, east, south, north = np.radians(self.box)
            solid_angle = (east - west) % (2.0 * np.pi) * (np.sin(north) - np.sin(south))
        elif self.vertices:
            solid_angle = _polygon_solid_angle(self.vertices)
        else:
            radii = np.array([patch[2] for patch in self.patches] or [self.radius])
            solid_angle = 4.0 * np.pi * np.sum(np.sin(0.5 * np.radians(radii)) ** 2)
        return float(np.degrees(np.degrees(solid_angle)))

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


def _polygon_solid_angle(vertices: Sequence[tuple[float, float]]) -> float:
    """Return the solid angle (sr) of a convex spherical polygon: the sum of the triangles at its first vertex.

    References
    ----------
    van Oosterom & Strackee 1983, IEEE Trans. Biomed. Eng. 30, 125
    """
    corners = sky.unit_vectors(*np.array(vertices).T)
    a, b, c = corners[0], corners[1:-1], corners[2:]
    triple = np.abs(np.sum(a * np.cross(b, c), axis=1))
    total = 1.0 + np.sum(a * b, axis=1) + np.sum(b * c, axis=1) + np.sum(a * c, axis=1)
    return float(2.0 * np.sum(np.arctan2(triple, total)))


def side_normals(vertices: Sequence[tuple[float, float]]) -> Float:
    """Return the unit normals of the sides of a polygon, which point into it: float64[n, 3].

    `vertices` are right ascension and declination in degrees, in clockwise or counterclockwise order. The scalar
    products of all normals with a position in the polygon are 0 or larger.
    """
    corners = sky.unit_vectors(*np.array(vertices).T)
    sides = np.cross(corners, np.roll(corners, -1, 0))
    sides /= np.sqrt(np.sum(sides**2, axis=1, keepdims=True))
    return np.asarray(sides * np.sign(matrices.matmul(sides[0], corners[2])))


def _polygon_depth(vertices: Sequence[tuple[float, float]], ra: Float, dec: Float) -> Float:
    sides = side_normals(vertices)
    x, y = np.radians(ra), np.radians(dec)
    place = np.stack([np.cos(y) * np.cos(x), np.cos(y) * np.sin(x), np.sin(y)])
    depth = np.degrees(np.arcsin(np.clip(matrices.matmul(sides, place.reshape(3, -1)), -1.0, 1.0))).min(axis=0)
    return np.asarray(depth.reshape(np.shape(ra)))


def parse(table: Toml | None, path: str = "area") -> Area:
    """Read the section `area` of a request.

    Parameters
    ----------
    table : Toml or None
        The section, with exactly one of the keys "polygon", "cone", "box", "tile", "patches" and "wide"; None if it is
        missing.
    path : str, optional
        Name of the section, for error messages.

    Returns
    -------
    Area
        The area.

    Raises
    ------
    BadInput
        If the section is missing, has another number of keys, an unknown key or a wrong value. The message names it.
    OutOfRange
        If a number is out of range.
    """
    if table is None:
        raise BadInput(f"{path} is missing: add [{path}] with a line such as {_EXAMPLES}")
    table = as_table(table, path, None)
    if loose := [key for key in _CONE_KEYS if key in table]:
        form = f"cone = {{ {_cone_values(table)} }}"
        raise BadInput(f"{path}: {', '.join(loose)} must be in a table, in degrees: {form}")
    check_keys(table, path, _FORMS, {key: text.format(_cone_values(table.get(key))) for key, text in _PLACES.items()})
    if len(table) != 1:
        has = f"it has {', '.join(table)}" if table else f"such as {_EXAMPLES}"
        raise BadInput(f"{path} must have exactly one of {', '.join(_FORMS)}; {has}")
    readers = {
        "polygon": lambda: _polygon(table["polygon"], f"{path}.polygon"),
        "cone": lambda: _cone(table["cone"], f"{path}.cone"),
        "box": lambda: _box(table["box"], f"{path}.box"),
        "tile": lambda: _tile(integer(table, f"{path}.tile", 0, tile_count() - 1)),
        "patches": lambda: _patches(table["patches"], f"{path}.patches"),
        "wide": lambda: _wide(boolean(table, f"{path}.wide", True), path),
    }
    return readers[next(iter(table))]()


def _cone_values(value: object) -> str:
    """Return the keys of a circle with the user's values, from a table or a list of three numbers, for a message."""
    if isinstance(value, list) and len(value) == len(_CONE_KEYS):
        value = dict(zip(_CONE_KEYS, value, strict=True))
    values = value if isinstance(value, dict) else {}
    return ", ".join(f"{key} = {quote_value(values[key]) if key in values else '..'}" for key in _CONE_KEYS)


def _cone(value: object, path: str) -> Area:
    if isinstance(value, list) and len(value) == len(_CONE_KEYS):
        raise BadInput(f"{path} must be a table, not a list: write {path} = {{ {_cone_values(value)} }}")
    cone = as_table(value, path, _CONE_KEYS)
    with Mistakes() as mistakes:
        ra = mistakes.read(sky_notation.ra_of, cone, f"{path}.ra")
        dec = mistakes.read(sky_notation.dec_of, cone, f"{path}.dec")
        radius = mistakes.read(number, cone, f"{path}.radius", 0.0, 180.0, unit="deg")
    return Area(ra=ra, dec=dec, radius=radius)


def _box(value: object, path: str) -> Area:
    if isinstance(value, dict) and not value.keys() & {"ra", "dec"}:
        given = f"got {', '.join(value)}" if value else "it has neither"
        raise BadInput(f"{path} must have ra and dec, {given}: write box = {{ ra = [150, 151], dec = [2, 3] }} (deg)")
    box = as_table(value, path, ("ra", "dec"))
    with Mistakes() as mistakes:
        ra_range = mistakes.read(_angle_pair, box, f"{path}.ra", "ra", _BOX_RA_LIMITS)
        dec_range = mistakes.read(_angle_pair, box, f"{path}.dec", "dec", DEC_LIMITS)
    west, east = ra_range
    south, north = dec_range
    # A box may cross right ascension 0: the range [350, 10] has a width of 20 deg.
    width = east - west + (360.0 if east < west else 0.0)
    if not 0.0 < width < 180.0:
        raise BadInput(f"{path}.ra = [{west}, {east}]: the second must be east of the first by less than 180 deg")
    if not north > south:
        raise BadInput(f"{path}.dec = [{south}, {north}]: the second must be larger")
    return Area(box=(west % 360.0, east % 360.0, south, north))


def _angle_pair(table: Toml, path: str, axis: str, limits: tuple[float, float]) -> tuple[float, float]:
    """Read a list of two angles in degrees. `axis` is "ra" or "dec"; `limits` has the smallest and largest angle."""
    values = required_value(table, path, "it must be [from, to] in degrees")
    if not isinstance(values, list) or len(values) != 2:
        raise BadInput(f"{path} must be [from, to] in degrees, got {quote_value(values)}")
    with Mistakes() as mistakes:
        angles = [
            mistakes.read(sky_notation.angle, item, f"{path}[{i}]", axis, limits) for i, item in enumerate(values)
        ]
    return angles[0], angles[1]


def _polygon(value: object, path: str) -> Area:
    vertices = tuple((ra, dec) for ra, dec in _coordinate_lists(value, path, 3, _MAX_VERTICES))
    try:
        sky.cells_in_polygon(vertices, 0)
    except BadInput as error:
        raise error.with_prefix(path) from None
    return Area(vertices=vertices)


def _tile(tile: int) -> Area:
    return Area(vertices=tuple((float(ra), float(dec)) for ra, dec in tile_corners(tile)))


def _patches(value: object, path: str) -> Area:
    def radius_of(item: object, radius_path: str) -> float:
        return checked_number(item, radius_path, 0.0, 90.0, "deg")

    circles = _coordinate_lists(value, path, 1, _MAX_PATCHES, radius_of)
    return Area(patches=tuple((ra, dec, radius) for ra, dec, radius in circles))


def _coordinate_lists(
    value: object,
    path: str,
    min_count: int,
    max_count: int,
    read_radius: Callable[[object, str], float] | None = None,
) -> list[list[float]]:
    """Read `min_count` to `max_count` lists [ra, dec], or [ra, dec, radius] if `read_radius` is given, in degrees.

    `read_radius` is a function of a value and its path. Right ascensions are converted to 0 to 360. Raises BadInput,
    which names `path`, if the value is not such a list.
    """
    form = "[ra, dec]" if read_radius is None else "[ra, dec, radius]"
    count = form.count(",") + 1
    if isinstance(value, list) and len(value) >= count and all(isinstance(item, (int, float, str)) for item in value):
        raise BadInput(f"{path} must be a list of {form} in degrees: write [{quote_value(value[:count])}, ..]")
    if not isinstance(value, list) or not min_count <= len(value) <= max_count:
        actual = len(value) if isinstance(value, list) else quote_value(value)
        raise BadInput(f"{path} must be a list of {min_count} to {max_count} {form} in degrees, got {actual}")
    places = []
    with Mistakes() as mistakes:
        for i, place in enumerate(value):
            if not isinstance(place, list) or len(place) != count:
                mistakes.add(BadInput(f"{path}[{i}] must be {form} in degrees, got {quote_value(place)}"))
                continue
            ra = mistakes.read(sky_notation.angle, place[0], f"{path}[{i}].ra", "ra", RA_LIMITS)
            dec_path = f"{path}[{i}].dec"
            numbers = [ra, mistakes.read(sky_notation.angle, place[1], dec_path, "dec", DEC_LIMITS, place[0])]
            if read_radius is not None:
                numbers.append(mistakes.read(read_radius, place[2], f"{path}[{i}].radius"))
            places.append(numbers)
    return [[ra % 360.0, *rest] for ra, *rest in places]


def _wide(enabled: bool, path: str) -> Area:
    if not enabled:
        raise BadInput(f"{path}.wide must be true, got false: select another area or delete the key")
    return Area(wide=True)
