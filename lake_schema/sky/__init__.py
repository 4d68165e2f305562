"""Geometry of the sky: nested HEALPix cells, cones, boxes and polygons, separations, Galactic coordinates.

Angles are in degrees and positions in ICRS unless stated otherwise. Functions that return the HEALPix cells that a
region touches never miss a cell, but may return a few cells just outside.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float, Float32, Int
from lake_schema.errors import BadInput, OutOfRange
from lake_schema.lazy_healpy import healpy

MAX_ORDER = 29
# Smallest triple product of the unit vectors to three consecutive vertices of a polygon that healpy accepts. A smaller
# value means that the vertices lie on one great circle.
_MIN_TRIPLE_PRODUCT = 1e-10
# Smallest ratio of the radius of a circle to the width of the cells that cover it. With finer cells, hardly fewer rows
# outside the circle would be read.
_CELLS_PER_RADIUS = 4
# Safety margin of distances (deg), larger than any rounding error.
_ROUNDING_DEG = 1e-9


def check_positions(ra: npt.ArrayLike, dec: npt.ArrayLike) -> tuple[Float, Float]:
    """Check positions ra, dec (deg, any shape), and return them as float arrays with ra wrapped to [0, 360).

    Raises
    ------
    OutOfRange
        If a coordinate is NaN or infinite, or |dec| > 90. The message gives the first such value.
    """
    ra_deg, dec_deg = np.asarray(ra, float), np.asarray(dec, float)
    if not np.isfinite(ra_deg).all():
        raise OutOfRange("ra", _first(ra_deg[~np.isfinite(ra_deg)]), 0.0, 360.0)
    bad = ~(np.abs(dec_deg) <= 90.0)
    if bad.any():
        raise OutOfRange("dec", _first(dec_deg[bad]), -90.0, 90.0)
    return wrap_angle(ra_deg), dec_deg


def wrap_angle(angle: npt.ArrayLike) -> Float:
    """Wrap angles (deg, any shape) to the range from 0 (included) to 360 (excluded); NaN stays NaN."""
    remainder = np.mod(np.asarray(angle, float), 360.0)
    # For a tiny negative angle, the remainder is rounded up to exactly 360.
    angle_deg: Float = np.where(remainder >= 360.0, 0.0, remainder)[()]
    return angle_deg


def wrap_position_angle(angle: npt.ArrayLike) -> Float32:
    """Wrap position angles of axes (deg, any shape) to the range from 0 (included) to 180 (excluded), as float32."""
    remainder = np.mod(np.asarray(angle), 180.0).astype(np.float32)
    # Replace 180 by 0: a remainder just below 180 (of a tiny negative angle, for example) may round up in float32.
    return np.where(remainder >= 180.0, np.float32(0.0), remainder)


def _first(values: Float) -> float:
    return float(values.ravel()[0])


def healpix_29(ra: npt.ArrayLike, dec: npt.ArrayLike) -> Int:
    """Return the nested HEALPix index of order 29 (cells of 0.4 mas) of positions ra, dec (deg, shape (n,)), as int64.

    Raise OutOfRange if a coordinate is not finite, or |dec| > 90.
    """
    return cell_at(ra, dec, MAX_ORDER)


def cell_at(ra: npt.ArrayLike, dec: npt.ArrayLike, order: int) -> Int:
    """Return the nested HEALPix cell that contains each position.

    Parameters
    ----------
    ra, dec : float array, shape (n,)
        Positions in deg; any ra, |dec| <= 90.
    order : int
        HEALPix order of the cells, 0 to 29.

    Returns
    -------
    int64 array, shape (n,)
        Nested cell numbers. OutOfRange is raised if a coordinate is not finite, or |dec| > 90.
    """
    ra_deg, dec_deg = check_positions(ra, dec)
    return np.asarray(healpy.ang2pix(1 << order, ra_deg, dec_deg, nest=True, lonlat=True), np.int64)


def cell_area(order: int) -> float:
    """Return the area in deg2 of a HEALPix cell of an order; all cells of an order have the same area."""
    return float(np.degrees(np.sqrt(np.pi / 3)) ** 2 / 4**order)


def cell_centre(order: int, cell: int) -> tuple[float, float]:
    """Return ra, dec (deg) of the centre of a nested HEALPix cell."""
    ra, dec = healpy.pix2ang(1 << order, cell, nest=True, lonlat=True)
    return float(ra), float(dec)


def cell_centres(order: int, cells: npt.ArrayLike) -> tuple[Float, Float]:
    """Return ra, dec (deg, arrays of shape (n,)) of the centres of nested HEALPix cells of one order."""
    ra, dec = healpy.pix2ang(1 << order, np.asarray(cells, np.int64), nest=True, lonlat=True)
    return np.asarray(ra, float), np.asarray(dec, float)


def cell_corners(order: int, cells: npt.ArrayLike) -> Float:
    """Return the corners of nested HEALPix cells of one order.

    Returns
    -------
    float array, shape (n, 4, 2)
        ra, dec in deg of the north, west, south and east corner of each cell. The result for cells that do not exist is
        undefined.

    Notes
    -----
    The formulas are written out here to avoid healpy, whose import would delay the first sky map on a web page.

    References
    ----------
    Gorski et al. 2005, ApJ 622, 759, eqs. 4-9 and 17-22
    """
    nested = np.atleast_1d(np.asarray(cells, np.int64))
    face, within = nested >> (2 * order), nested & ((1 << 2 * order) - 1)
    # Coordinates x, y of the corners in their base cell (one of the 12 cells of order 0), 0 to 1. They increase to the
    # north-east (x) and to the north-west (y).
    x, y = ((_even_bits(within >> bit)[:, None] + np.array(step)) / (1 << order)
            for bit, step in ((0, (1, 0, 0, 1)), (1, (1, 1, 0, 0))))  # fmt: skip
    # `row` is the row of the base cell, 2 (north) to 4 (south); `column` is the right ascension of its centre / 45 deg.
    row, column = face // 4 + 2, 2 * (face % 4) + (face // 4 != 1)
    height = row[:, None] - x - y
    polar = (height < 1.0) | (height > 3.0)
    # Distance of a corner from the nearer pole in units of the height of a polar cap; 1 outside the polar caps.
    depth = np.where(height < 1.0, height, np.where(height > 3.0, 4.0 - height, 1.0))
    z = np.where(polar, np.sign(2.0 - height) * (1.0 - depth**2 / 3.0), (2.0 - height) * 2.0 / 3.0)
    dec = np.where(
        polar & (depth < 0.5),
        # Near the poles, use a formula without arcsin(z), which loses digits because |z| is close to 1.
        np.sign(2.0 - height) * (90.0 - 2.0 * np.degrees(np.arcsin(depth / np.sqrt(6.0)))),
        np.degrees(np.arcsin(z)),
    )
    ra = 45.0 * (column[:, None] + np.divide(x - y, depth, out=np.zeros_like(depth), where=depth > 0.0))
    return np.stack([ra % 360.0, dec], -1)


def _even_bits(bits: Int) -> Int:
    """Return integers whose bits 0, 1, 2 and so on are the even-numbered bits (0, 2, 4 and so on) of `bits`."""
    packed = bits & 0x5555555555555555
    for shift, mask in (
        (1, 0x3333333333333333), (2, 0x0F0F0F0F0F0F0F0F), (4, 0x00FF00FF00FF00FF), (8, 0x0000FFFF0000FFFF),
        (16, 0x00000000FFFFFFFF),
    ):  # fmt: skip
        packed = (packed | packed >> shift) & mask
    return np.asarray(packed, np.int64)


def cell_range(order: int, cell: int) -> tuple[int, int]:
    """Return the first nested index of order 29 inside a HEALPix cell, and the first index after the cell."""
    shift = 2 * (MAX_ORDER - order)
    return int(cell) << shift, (int(cell) + 1) << shift


def parent(cells: npt.ArrayLike, order: int, coarser: int) -> Int:
    """Return the cells of a lower HEALPix order that contain the given nested cells.

    Parameters
    ----------
    cells : int array, shape (n,)
        Nested HEALPix cells.
    order : int
        HEALPix order of `cells`.
    coarser : int
        HEALPix order of the result, at most `order`; not checked.

    Returns
    -------
    int64 array, shape (n,)
        Nested cells of order `coarser`.
    """
    return np.asarray(cells, np.int64) >> (2 * (order - coarser))


def cell_radius(order: int) -> float:
    """Return the largest distance (deg) between the centre and a corner of any HEALPix cell of an order."""
    return float(np.degrees(healpy.max_pixrad(1 << order)))


def cells_in_cone(ra: float, dec: float, radius: float, order: int) -> Int:
    """Return the HEALPix cells that a circle on the sky touches, sorted.

    Parameters
    ----------
    ra, dec : float
        Centre of the circle in deg.
    radius : float
        Radius in deg, 0 to 180.
    order : int
        HEALPix order of the cells.

    Returns
    -------
    int64 array, shape (n,)
        All nested cells that the circle touches, and possibly neighbours whose edges are just outside.

    Raises
    ------
    OutOfRange
        If the radius is outside its limits, a coordinate is not finite, or |dec| > 90.
    """
    (ra_deg,), (dec_deg,) = check_positions([ra], [dec])
    if not 0.0 <= radius <= 180.0:
        raise OutOfRange("radius", radius, 0.0, 180.0)
    centre = healpy.ang2vec(ra_deg, dec_deg, lonlat=True)
    fine = min(order + 3, MAX_ORDER)
    fine_cells = healpy.query_disc(1 << fine, centre, np.radians(min(radius + cell_radius(fine), 180.0)), nest=True)
    centre_cell = cell_at([ra], [dec], order)
    return np.unique(np.concatenate([parent(fine_cells, fine, order), centre_cell]))


def cover_order(radius: float) -> int:
    """Return the HEALPix order of cells whose width is between an eighth and a quarter of a circle's radius (deg).

    Such cells cover the circle without much area outside. The order is at least 0 and at most 26, so the cells are
    wider than that for circles with a radius below 13 mas.
    """
    cell_width = max(radius / _CELLS_PER_RADIUS, 1e-7)
    order = int(np.ceil(np.log2(np.sqrt(cell_area(0)) / cell_width)))
    return min(max(order, 0), MAX_ORDER - 3)


def cells_in_cones(ra: npt.ArrayLike, dec: npt.ArrayLike, radius: npt.ArrayLike, order: int) -> list[Int]:
    """Return the HEALPix cells that each of many circles on the sky touches, sorted for each circle.

    Parameters
    ----------
    ra, dec : float array, shape (n,)
        Centres of the circles in deg.
    radius : float array, shape (n,)
        Radii in deg, 0 to 180.
    order : int
        HEALPix order of the cells.

    Returns
    -------
    list of int64 array, length n
        Nested cells that each circle touches, and possibly neighbours just outside; equal to the results of
        `cells_in_cone`.

    Raises
    ------
    OutOfRange
        If a radius is outside its limits, a coordinate is not finite, or |dec| > 90.

    Notes
    -----
    The function is fast if the circles lie close together, such as the circles around the detectors of a camera. Time
    and memory are proportional to n times the number of cells near any circle.
    """
    lon, lat = check_positions(ra, dec)
    radii, fine = np.asarray(radius, float), min(order + 3, MAX_ORDER)
    if not lon.size:
        return []
    if not ((radii >= 0.0) & (radii <= 180.0)).all():
        raise OutOfRange("radius", _first(radii[~((radii >= 0.0) & (radii <= 180.0))]), 0.0, 180.0)
    centres, centre_cells = unit_vectors(lon, lat), cell_at(lon, lat, order)
    reach = np.minimum(radii + cell_radius(fine), 180.0)
    size = cell_radius(order) + _ROUNDING_DEG
    widest = float((separation(lon, lat, lon[0], lat[0]) + radii).max()) + size
    candidates = cells_in_cone(float(lon[0]), float(lat[0]), min(widest, 180.0), order)
    # For most cells, the distance of the centre from the circle decides whether the circle touches the cell. For cells
    # on its edge, the distances of the centres of finer cells decide.
    cell_centres_xyz = healpy.pix2vec(1 << order, candidates, nest=True)
    cos_distance = sum(centres[:, i, None] * cell_centres_xyz[i] for i in range(3))
    inside_limit = np.where(reach > size, np.cos(np.radians(np.maximum(reach - size, 0.0))), np.inf)
    touched = cos_distance >= inside_limit[:, None]
    circle, unsure = np.nonzero(
        ~touched & (cos_distance >= np.cos(np.radians(np.minimum(reach + size, 180.0)))[:, None])
    )
    finer_centres = _finer_centres(candidates, order, fine)[:, unsure]
    cos_distance = sum(finer_centres[i] * centres[circle, i, None] for i in range(3))
    touched[circle, unsure] = (cos_distance >= np.cos(np.radians(reach))[circle, None]).any(axis=1)
    touched |= candidates == centre_cells[:, None]
    return [candidates[row] for row in touched]


def _finer_centres(cells: Int, order: int, finer: int) -> Float:
    """Return unit vectors, shape (3, n, m), to the centres of the m cells of order `finer` in each of n nested cells.

    `order` is the order of the n cells.
    """
    finer_count = 1 << 2 * (finer - order)
    inside = (np.asarray(cells)[:, None] << 2 * (finer - order)) + np.arange(finer_count)
    return np.array(healpy.pix2vec(1 << finer, inside, nest=True))


def cells_in_polygon(vertices: npt.ArrayLike, order: int) -> Int:
    """Return the HEALPix cells that a convex spherical polygon touches, sorted; its sides are great circles.

    Parameters
    ----------
    vertices : float array, shape (n, 2)
        ra, dec of the vertices in deg, clockwise or counterclockwise, n >= 3.
    order : int
        HEALPix order of the cells.

    Returns
    -------
    int64 array, shape (m,)
        All nested cells that the polygon touches, and possibly neighbours whose edges are just outside.

    Raises
    ------
    BadInput
        If the vertices have another shape, two of them are equal, three consecutive ones lie on a great circle, or the
        polygon is not convex.
    OutOfRange
        If a coordinate is not finite, or |dec| > 90.
    """
    corners = np.asarray(vertices, float)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
        raise BadInput(f"a polygon must have at least 3 vertices (ra, dec), got shape {corners.shape}")
    ra, dec = check_positions(corners[:, 0], corners[:, 1])
    vectors = healpy.ang2vec(ra, dec, lonlat=True)
    _refuse_not_convex(vectors)
    fine = min(order + 3, MAX_ORDER)
    inside = healpy.query_polygon(1 << fine, vectors, inclusive=True, fact=4, nest=True)
    return np.unique(parent(inside, fine, order))


def _refuse_not_convex(vectors: Float) -> None:
    sides = np.cross(vectors, np.roll(vectors, -1, 0))
    flat = np.abs(np.einsum("ij,ij->i", sides, np.roll(vectors, -2, 0))) <= _MIN_TRIPLE_PRODUCT
    if flat.any():
        corner = (int(flat.argmax()) + 1) % len(vectors) + 1
        raise BadInput(
            f"a polygon must be convex: vertex {corner} lies on the great circle of its neighbours, or on one of them"
        )
    # Check that all vertices lie on the same side of each edge. A check that all turns have the same direction would
    # accept a pentagram.
    heights = np.einsum("ij,kj->ik", sides, vectors)
    ends = np.arange(len(vectors))
    heights[ends, ends] = heights[ends, (ends + 1) % len(vectors)] = np.sign(heights[0, 2])
    if not ((heights > 0).all() or (heights < 0).all()):
        raise BadInput("a polygon must be convex, with no repeated vertex and no angle of 180 deg")


def cells_in_box(west: float, east: float, south: float, north: float, order: int) -> Int:
    """Return the HEALPix cells that a box between two meridians and two parallels touches, sorted.

    Parameters
    ----------
    west, east : float
        Right ascension of the edges in deg, wrapped to [0, 360). The box extends from `west` eastward to `east`, across
        ra = 0 if east < west. If both are equal, it has no width.
    south, north : float
        Declination of the edges in deg, -90 to 90, south <= north.
    order : int
        HEALPix order of the cells.

    Returns
    -------
    int64 array, shape (m,)
        All nested cells that the box touches, and possibly neighbours whose edges are just outside. OutOfRange is
        raised if an edge is not finite or |dec| > 90.
    """
    ra, dec = check_positions([west, east], [south, north])
    fine = min(order + 3, MAX_ORDER)
    reach = cell_radius(fine)
    low, high = max(dec[0] - reach, -90.0), min(dec[1] + reach, 90.0)
    # `query_strip` takes colatitudes, which increase to the south, so the northern limit comes first.
    strip = healpy.query_strip(1 << fine, np.radians(90.0 - high), np.radians(90.0 - low), inclusive=True)
    fine_cells = healpy.ring2nest(1 << fine, strip)
    lon, lat = healpy.pix2ang(1 << fine, fine_cells, nest=True, lonlat=True)
    # Largest extent of a cell in right ascension from its centre (deg). It is 360 for cells near a pole, which may
    # contain all meridians.
    widest = np.cos(np.radians(np.minimum(np.abs(lat) + reach, 90.0)))
    margin = np.where(widest > np.radians(reach), reach / np.maximum(widest, 1e-9), 360.0)
    eastward = (lon - ra[0] + margin) % 360.0
    span = (ra[1] - ra[0]) % 360.0
    inside = (eastward <= span + 2 * margin) | (2 * margin + span >= 360.0)
    return np.unique(parent(fine_cells[inside], fine, order))


def separation(ra1: npt.ArrayLike, dec1: npt.ArrayLike, ra2: npt.ArrayLike, dec2: npt.ArrayLike) -> Float:
    """Return the great-circle distance between positions, accurate from 0 to 180 deg (haversine formula).

    Parameters
    ----------
    ra1, dec1 : float array
        First positions in deg.
    ra2, dec2 : float array
        Second positions in deg. The shapes of all four arrays are broadcast.

    Returns
    -------
    float array
        Distances in deg, of the broadcast shape; NaN if a coordinate is NaN.
    """
    # The remainder is exact, whereas the conversion of many turns to radians loses digits.
    lon1, lon2 = (np.radians(np.fmod(np.asarray(x, float), 360.0)) for x in (ra1, ra2))
    lat1, lat2 = (np.radians(np.asarray(x, float)) for x in (dec1, dec2))
    dlon, dlat = np.sin((lon2 - lon1) / 2), np.sin((lat2 - lat1) / 2)
    haversine = dlat**2 + np.cos(lat1) * np.cos(lat2) * dlon**2
    # `complement` equals 1 - haversine. This formula has no rounding error near a separation of 180 deg, where the
    # difference would lose digits.
    complement = np.sin((lat1 + lat2) / 2) ** 2 + np.cos(lat1) * np.cos(lat2) * np.cos((lon2 - lon1) / 2) ** 2
    return np.asarray(np.degrees(2 * np.arctan2(np.sqrt(haversine), np.sqrt(complement))))


def offset_positions(ra: Float, dec: Float, east: Float, north: Float) -> tuple[Float, Float]:
    """Move positions along great circles.

    Parameters
    ----------
    ra, dec : float array, shape (n,)
        Positions in deg.
    east, north : float array, shape (n,)
        Components of the shift in rad, towards increasing ra and dec at the position.

    Returns
    -------
    ra, dec : float array, shape (n,)
        Moved positions in deg.
    """
    angle = np.hypot(east, north)
    # sin(angle) / angle; np.sinc returns 1 for angle = 0.
    ratio = np.sinc(angle / np.pi)
    lat, lon = np.radians(dec), np.radians(np.fmod(ra, 360.0))
    forward = np.cos(angle) * np.cos(lat) - ratio * north * np.sin(lat)
    up = np.cos(angle) * np.sin(lat) + ratio * north * np.cos(lat)
    sideways = ratio * east
    moved = lon + np.arctan2(sideways, forward)
    return wrap_angle(np.degrees(moved)), np.degrees(np.arctan2(up, np.hypot(forward, sideways)))


def random_in_cell(order: int, cell: int, n: int, rng: np.random.Generator) -> tuple[Int, Float, Float]:
    """Draw random positions that are uniformly distributed in a HEALPix cell.

    Parameters
    ----------
    order : int
        HEALPix order of the cell.
    cell : int
        Nested cell number.
    n : int
        Number of positions.
    rng : numpy.random.Generator
        Source of random numbers.

    Returns
    -------
    index : int64 array, shape (n,)
        Nested HEALPix indices of order 29, ascending.
    ra, dec : float array, shape (n,)
        Positions in deg: the centres of these order-29 cells, which are 0.4 mas wide.
    """
    first, _ = cell_range(order, cell)
    index = np.sort(rng.integers(0, 1 << (2 * (MAX_ORDER - order)), n, dtype=np.int64)) | np.int64(first)
    ra, dec = healpy.pix2ang(1 << MAX_ORDER, index, nest=True, lonlat=True)
    return index, ra, dec


def positions_of_indices(index: npt.ArrayLike) -> tuple[Float, Float]:
    """Return ra, dec (deg, arrays of shape (n,)) of the centres of nested HEALPix cells of order 29."""
    ra, dec = healpy.pix2ang(1 << MAX_ORDER, np.asarray(index, np.int64), nest=True, lonlat=True)
    return np.asarray(ra, float), np.asarray(dec, float)


def unit_vectors(ra: npt.ArrayLike, dec: npt.ArrayLike) -> Float:
    """Return Cartesian unit vectors, shape (..., 3), towards positions ra, dec (deg, any shape)."""
    return np.moveaxis(
        _unit_vector_components(np.radians(np.asarray(ra, float)), np.radians(np.asarray(dec, float))), 0, -1
    )


def _unit_vector_components(lon: Float, lat: Float) -> Float:
    """Return the components x, y, z, shape (3, ...), of unit vectors towards lon, lat (rad, any shape)."""
    return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])


def galactic(ra: npt.ArrayLike, dec: npt.ArrayLike) -> tuple[Float, Float]:
    """Convert ICRS ra, dec (deg, any shape) to Galactic longitude l in [0, 360) and latitude b (deg).

    Positions are not checked; NaN gives NaN.

    References
    ----------
    ESA 1997, The Hipparcos and Tycho Catalogues, eq. 1.5.11 (matrix)
    """
    ra_rad, dec_rad = np.radians(np.asarray(ra, float)), np.radians(np.asarray(dec, float))
    x, y, z = _rotate(TO_GALACTIC, _unit_vector_components(ra_rad, dec_rad))
    return wrap_angle(np.degrees(np.arctan2(y, x))), np.degrees(np.arctan2(z, np.hypot(x, y)))


def equatorial(lon: npt.ArrayLike, lat: npt.ArrayLike) -> tuple[Float, Float]:
    """Convert Galactic longitude and latitude (deg, any shape) to ICRS ra in [0, 360) and dec (deg).

    Positions are not checked; NaN gives NaN.
    """
    l_rad, b_rad = np.radians(np.asarray(lon, float)), np.radians(np.asarray(lat, float))
    x, y, z = _rotate(TO_GALACTIC.T, _unit_vector_components(l_rad, b_rad))
    return wrap_angle(np.degrees(np.arctan2(y, x))), np.degrees(np.arctan2(z, np.hypot(x, y)))


def _rotate(matrix: Float, vector: Float) -> Float:
    """Multiply a matrix, shape (3, 3), by vectors, shape (3, ...), with equal results on all processors.

    The sums are written out, because the order of sums in numpy's matrix product depends on the processor.
    """
    return np.stack([row[0] * vector[0] + row[1] * vector[1] + row[2] * vector[2] for row in matrix])


TO_GALACTIC = np.array(
    [
        [-0.0548755604162154, -0.8734370902348850, -0.4838350155487132],
        [+0.4941094278755837, -0.4448296299600112, +0.7469822444972189],
        [-0.8676661490190047, -0.1980763734312015, +0.4559837761750669],
    ]
)


def ring_index(order: int, cell: int) -> int:
    """Return the number in HEALPix RING ordering of the cell with a number in NESTED ordering."""
    return int(healpy.nest2ring(1 << order, cell))


def border_cells(order: int, cell: int, fine: int) -> Int:
    """Return the cells of a higher HEALPix order inside a cell that touch its border.

    Parameters
    ----------
    order : int
        HEALPix order of the cell.
    cell : int
        Nested number of the cell.
    fine : int
        HEALPix order of the result, at least `order`.

    Returns
    -------
    int64 array, shape (n,)
        Nested cells of order `fine`, sorted.
    """
    side = 1 << (fine - order)
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    rim = (x == 0) | (y == 0) | (x == side - 1) | (y == side - 1)
    within = healpy.xyf2pix(side, x[rim], y[rim], 0, nest=True)
    return np.sort((np.int64(cell) << (2 * (fine - order))) + within)


def margin_cells(order: int, cell: int, fine: int) -> Int:
    """Return the cells of a higher HEALPix order outside a cell that touch its border or one of its corners.

    Parameters
    ----------
    order : int
        HEALPix order of the cell.
    cell : int
        Nested number of the cell.
    fine : int
        HEALPix order of the result, at least `order`.

    Returns
    -------
    int64 array, shape (n,)
        Nested cells of order `fine`, sorted.
    """
    neighbours = healpy.get_all_neighbours(1 << fine, border_cells(order, cell, fine), nest=True).ravel()
    neighbours = np.unique(neighbours[neighbours >= 0]).astype(np.int64)
    outside: Int = neighbours[parent(neighbours, fine, order) != cell]
    return outside
