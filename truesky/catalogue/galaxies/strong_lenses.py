"""Draw strong lenses: singular isothermal ellipsoids (SIE), and images of the sources behind them by ray shooting.

Every galaxy beyond z = 0.02 that is redder than the blue sequence can be a lens. The total cross-section follows from
the fourth moment of the velocity dispersions, which agrees with Choi et al. 2007 within 15 % at 0.1 < z < 0.7. With the
detection criteria of Collett 2015, the number of lenses is 10.2 +- 1.1 deg-2 for sources with I_E < 26 and z < 2.3
(14.9 +- 1.3 for all sources). Collett 2015 predicts 11.3. Central galaxies of halos above 10^12.7 Msun/h are only a
fifth of the lenses: most lenses are galaxies of smaller halos.

Coordinates are in arcsec east and north of the lens on the tangent plane. The images contain only the smooth lens; weak
lensing by matter in front of and behind the lens is left out.

References
----------
Kormann, Schneider & Bartelmann 1994, A&A 284, 285
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import scipy

from lake_schema import ids, sky
from lake_schema.arrays import Array, Bool, Float, Float32, Int
from lake_schema.ids import GENERATION_ORDER
from lake_schema.tables.strong_lenses import STRONG_LENSES
from lake_schema.units import LIGHT_KM_S
from truesky.catalogue import parameters
from truesky.catalogue.galaxies import lens_pairs
from truesky.catalogue.halos import luminosity_function
from truesky.cosmology import Cosmology
from truesky.randomness import per_source
from truesky.randomness.per_source import PerSourceGenerator

COLUMNS = (
    "id", "kind", "ra", "dec", "_healpix_29", "ra_true", "dec_true", "z_true", "abs_mag_r01", "color_gr_01",
    "disk_half_light_radius", "disk_axis_ratio", "position_angle",
)  # fmt: skip
# Code of strong lenses in column `kind` and in identifiers.
STRONG_LENS = 4
_FILE = "strong_lenses.toml"
# A lens must have a total magnification above `least_magnification` (strong_lenses.toml). To save time, no exact
# image is computed if an image with one ray per pixel has less than this fraction of that limit.
_QUICK_SHARE = 0.7
# Half-light radius of an exponential disc in units of its scale length.
_B = 1.6783469900166605
# Number of directions, uniform over the circle, in which `image_positions` searches for images. Two images that are
# closer than one step of direction can be missed; they are about to merge at a caustic.
_ANGLE_COUNT = 4096
# Fraction of the sources with which a lens is compared, to save time. A lens is compared with all sources if its
# probability to lens a given source is at least this large. This happens only if the boost, the ratio of the drawn to
# the natural number of lenses, is large.
_WINDOW = 1.0 / 64.0


@dataclass(frozen=True, slots=True)
class Lens:
    """Singular isothermal ellipsoid (SIE).

    Attributes
    ----------
    radius : float
        Einstein radius, arcsec.
    axis_ratio : float
        Minor / major axis.
    angle : float
        Position angle of the major axis, deg from north through east.
    """

    radius: float
    axis_ratio: float
    angle: float


@dataclass(frozen=True, slots=True)
class Disc:
    """Light of a lensed source: an exponential disc of flux 1.

    Attributes
    ----------
    east, north : float
        Position relative to the lens, arcsec.
    radius : float
        Half-light semi-major axis, arcsec.
    axis_ratio : float
        Minor / major axis.
    angle : float
        Position angle of the major axis, deg from north through east.
    """

    east: float
    north: float
    radius: float
    axis_ratio: float
    angle: float


@dataclass(frozen=True, slots=True)
class Laws:
    """Parameters of the selection and the properties of lenses; explained in strong_lenses.toml, [lenses]."""

    reddest_blue: float
    sigma_star: float
    scatter: float
    axis_ratio: float
    axis_ratio_scatter: float
    axis_ratio_limits: tuple[float, float]
    least_z_apart: float
    least_radius: float
    least_magnification: float


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """A lens and a source behind it.

    Attributes
    ----------
    lens, source : int
        Rows of lens and source in the table of galaxies.
    sigma : float
        Velocity dispersion of the lens, km/s.
    radius : float
        Einstein radius, arcsec.
    key : int
        64-bit number that identifies the pair; the identifier of the strong lens is made from it.
    numbers : float array, shape (4,)
        Random numbers that decide about the pair, the axis ratio of the lens, and the distance and direction of the
        source. The second is a standard normal deviate, the others are uniform.
    """

    lens: int
    source: int
    sigma: float
    radius: float
    key: int
    numbers: Float


@dataclass(frozen=True, slots=True)
class Stamps:
    """Pixel scale, size and sampling of the images of lensed sources; explained in strong_lenses.toml, [stamp]."""

    pixel_scale: float
    sides: tuple[int, int]
    samples: tuple[int, int]
    samples_a_radius: float


def laws() -> Laws:
    """Return the built-in parameters of the selection and the properties of lenses."""
    return Laws(**parameters.section(_FILE, "lenses"))


def stamps() -> Stamps:
    """Return the built-in pixel scale, size and sampling of the images of lensed sources."""
    return Stamps(**parameters.section(_FILE, "stamp"))


def draw(cell: int, galaxies: pa.Table, seed: int, boost: float, cosmology: Cosmology) -> pa.Table:
    """Draw the rows of table `strong_lenses` in one order-8 cell.

    Parameters
    ----------
    cell : int
        Nested index of the order-8 cell.
    galaxies : Table
        Rows of table `galaxies` in the cell, with the columns COLUMNS.
    seed : int
        Seed of the request.
    boost : float
        Ratio of the drawn to the natural number density of strong lenses.
    cosmology : Cosmology
        Parameters of the universe.

    Returns
    -------
    Table
        Rows of table `strong_lenses`, sorted by the order-29 cell of the lens, then by identifier. Empty if no source
        is magnified enough.

    Notes
    -----
    The position of a source is independent of lenses: it is as likely within an Einstein radius of a lens as in any
    other area of the same size.
    """
    law, stamp_settings = laws(), stamps()
    columns = {name: galaxies[name].to_numpy() for name in COLUMNS}
    rows = []
    for pair in draw_pairs(law, cosmology, columns, columns["kind"] < 2, boost, seed):
        system = system_of_pair(law, columns, pair)
        side = _side(stamp_settings, *system)
        # An image with one ray per pixel takes little time, and excludes most lenses whose magnification is too small.
        if (
            shoot_rays(*system, replace(stamp_settings, samples=(1, 1)), side).sum()
            < _QUICK_SHARE * law.least_magnification
        ):
            continue
        picture = shoot_rays(*system, stamp_settings, side)
        total_magnification = float(picture.sum())
        if total_magnification > law.least_magnification:
            rows.append((pair, *system, picture, total_magnification))
    return _table(cell, columns, rows, boost)


def einstein_radius(
    cosmology: Cosmology, sigma: npt.ArrayLike, z_lens: npt.ArrayLike, z_source: npt.ArrayLike
) -> Float:
    """Return the Einstein radius of singular isothermal lenses in a flat universe.

    Parameters
    ----------
    cosmology : Cosmology
        Parameters of the universe.
    sigma : float array, shape (n,)
        Velocity dispersion of the lens, km/s.
    z_lens, z_source : float array, shape (n,)
        Redshifts of lens and source.

    Returns
    -------
    float array, shape (n,)
        4 pi (sigma / c)^2 D_ls / D_s in arcsec; 0 if the source is in front of the lens.
    """
    ratio = 1.0 - cosmology.comoving_distance(z_lens) / cosmology.comoving_distance(z_source)
    return _max_einstein_radius(sigma) * np.maximum(ratio, 0.0)


def _max_einstein_radius(sigma: npt.ArrayLike) -> Float:
    """Return the Einstein radius (arcsec) for sources at infinite distance, from the velocity dispersion (km/s)."""
    return np.asarray(np.degrees(4.0 * np.pi * (np.asarray(sigma, float) / LIGHT_KM_S) ** 2) * 3600.0)


def deflection(lens: Lens, east: Float, north: Float) -> tuple[Float, Float]:
    """Return the deflection angles of rays by a singular isothermal ellipsoid.

    Parameters
    ----------
    lens : Lens
        The lens.
    east, north : float array, any shape
        Positions of the rays in the image relative to the lens, arcsec.

    Returns
    -------
    east, north : float array, broadcast shape of the arguments
        Deflection, arcsec. The position minus the deflection is the place of the ray in the source plane.

    References
    ----------
    Kormann et al. 1994, eqs. 27a, 27b
    """
    along, across = _to_axes(lens.angle, east, north)
    q = lens.axis_ratio
    scale, flat = lens.radius * np.sqrt(q), np.sqrt(1.0 - q * q)
    psi = np.maximum(np.hypot(q * along, across), 1e-12)
    if flat < 1e-4:
        x, y = scale * along / psi, scale * across / psi
    else:
        x = scale / flat * np.arctan(flat * along / psi)
        y = scale / flat * np.arctanh(flat * across / psi)
    return _from_axes(lens.angle, x, y)


def magnification(lens: Lens, east: Float, north: Float) -> Float:
    """Return the magnification of images of point sources.

    Parameters
    ----------
    lens : Lens
        The lens.
    east, north : float array, any shape
        Positions of the images relative to the lens, arcsec.

    Returns
    -------
    float array, broadcast shape of the arguments
        1 / (1 - 2 kappa), where kappa is the convergence; negative for mirrored images, infinite on the critical curve.
    """
    along, across = _to_axes(lens.angle, east, north)
    return np.asarray(1.0 / (1.0 - lens.radius * np.sqrt(lens.axis_ratio) / np.hypot(lens.axis_ratio * along, across)))


def image_positions(lens: Lens, east: float, north: float) -> Float:
    """Find the images of a point source.

    Parameters
    ----------
    lens : Lens
        The lens.
    east, north : float
        Position of the source relative to the lens, arcsec.

    Returns
    -------
    float array, shape (n, 2)
        Positions of the n images (east, north) relative to the lens, arcsec; n is 0 if no image is found.

    Notes
    -----
    The deflection alpha of a singular isothermal ellipsoid depends only on the direction phi. With the position beta of
    the source and the unit vector e(phi), there is an image at distance r from the lens in every direction with::

        (beta + alpha(phi)) x e(phi) = 0    and    r = (beta + alpha(phi)) . e(phi) > 0
    """

    def across(phi: npt.ArrayLike) -> Any:
        e, n = np.cos(phi), np.sin(phi)
        x, y = deflection(lens, np.asarray(e), np.asarray(n))
        return (east + x) * n - (north + y) * e

    # Start at an arbitrary angle, so that no root of `across` is exactly at one of the angles in `phi`.
    phi = 0.1234567 + np.linspace(0.0, 2.0 * np.pi, _ANGLE_COUNT + 1)
    values = across(phi)
    images = []
    for i in np.flatnonzero(values[:-1] * values[1:] < 0.0):
        root = scipy.optimize.brentq(across, phi[i], phi[i + 1], xtol=1e-13)
        direction = np.array([np.cos(root), np.sin(root)])
        bent = deflection(lens, direction[:1], direction[1:])
        distance = (east + bent[0][0]) * direction[0] + (north + bent[1][0]) * direction[1]
        if distance > 0.0:
            images.append(distance * direction)
    return np.array(images).reshape(-1, 2)


def shoot_rays(lens: Lens, source: Disc, stamp_settings: Stamps, side: int) -> Float32:
    """Compute the image of a source of flux 1 by inverse ray shooting.

    Parameters
    ----------
    lens : Lens
        The lens.
    source : Disc
        Exponential disc behind the lens.
    stamp_settings : Stamps
        Pixel scale, and number of rays per pixel.
    side : int
        Side of the image, pixels.

    Returns
    -------
    float32 array, shape (side, side)
        Image centred on the lens. Rows run from south to north, columns from west to east. The sum of the pixels is the
        total magnification.

    Notes
    -----
    The error of the magnification is 1 % (tests) for sources with a half-light radius above a quarter of a pixel.
    """
    samples = np.ceil(
        stamp_settings.samples_a_radius * stamp_settings.pixel_scale / (source.radius * source.axis_ratio)
    )
    fine = int(np.clip(samples, *stamp_settings.samples))
    step = stamp_settings.pixel_scale / fine
    place = (np.arange(side * fine) - 0.5 * (side * fine - 1)) * step
    picture = np.empty((side, side), np.float32)
    rows = max(1, (1 << 20) // (side * fine * fine))
    for first in range(0, side, rows):
        north, east = np.meshgrid(place[first * fine : (first + rows) * fine], place, indexing="ij")
        x, y = deflection(lens, east, north)
        light = _brightness(source, east - x, north - y)
        picture[first : first + rows] = light.reshape(-1, fine, side, fine).mean((1, 3)) * stamp_settings.pixel_scale**2
    return picture


def draw_pairs(
    law: Laws, cosmology: Cosmology, columns: dict[str, Array], is_source: Bool, boost: float, seed: int
) -> list[Pair]:
    """Draw pairs of a lens and a source from the rows of table `galaxies` in a generation cell.

    Parameters
    ----------
    law : Laws
        Selection and properties of lenses.
    cosmology : Cosmology
        Parameters of the universe.
    columns : dict of str to array, shape (n,)
        Columns COLUMNS of the rows.
    is_source : bool array, shape (n,)
        True for the rows that may be sources.
    boost : float
        Ratio of the drawn to the natural number density of strong lenses.
    seed : int
        Seed of the request.

    Returns
    -------
    list of Pair
        The pairs. Each pair is drawn independently of all other pairs. A deeper catalogue therefore contains the same
        pairs and more.
    """
    area = sky.cell_area(GENERATION_ORDER) * 3600.0**2
    is_galaxy = columns["kind"] < 2
    lens = np.flatnonzero(is_galaxy & (columns["color_gr_01"] > law.reddest_blue) & (columns["z_true"] > 0.02))
    z_lens, rng = columns["z_true"][lens].astype(float), PerSourceGenerator(columns["id"][lens], seed, "strong_lenses")
    m_star, _, _ = luminosity_function.schechter().parameters_at(z_lens)
    brighter = m_star - columns["abs_mag_r01"][lens]
    sigma = law.sigma_star * 10.0 ** (0.1 * brighter + law.scatter * rng.standard_normal())
    # Draw the sources inside the Einstein radius for a source at infinity, which is an upper limit. Sources outside the
    # Einstein radius for their own redshift are removed below.
    max_radius = _max_einstein_radius(sigma)
    chance = boost * np.pi * max_radius**2 / area
    window = np.where(chance < _WINDOW, _WINDOW, 1.0)
    lenses = per_source.keys(columns["id"][lens], seed, "strong_lenses", "pair"), rng.random(), window, chance, z_lens

    source = np.flatnonzero(is_source)
    place = PerSourceGenerator(columns["id"][source], seed, "strong_lenses", "source").random()
    source, place = source[np.argsort(place)], np.sort(place)
    source_keys = per_source.keys(columns["id"][source], seed, "strong_lenses", "source")
    sources = source_keys, place, columns["z_true"][source].astype(float)
    out = _allocate(0)
    while (count := lens_pairs.find_pairs(lenses, sources, law.least_z_apart, out)) > out[0].size:
        out = _allocate(count)
    radius = einstein_radius(cosmology, sigma[out[0]], z_lens[out[0]], columns["z_true"][source[out[1]]])
    selected = (out[3][:, 0] * max_radius[out[0]] ** 2 < radius**2) & (radius > law.least_radius)
    return [
        Pair(
            int(lens[out[0][i]]),
            int(source[out[1][i]]),
            float(sigma[out[0][i]]),
            float(radius[i]),
            int(out[2][i]),
            out[3][i],
        )
        for i in np.flatnonzero(selected)
    ]


def _allocate(count: int) -> tuple[Int, Int, npt.NDArray[np.uint64], Float]:
    return np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count, np.uint64), np.empty((count, 4))


def system_of_pair(law: Laws, columns: dict[str, Array], pair: Pair) -> tuple[Lens, Disc]:
    """Return the lens and the source of a pair.

    Parameters
    ----------
    law : Laws
        Properties of lenses.
    columns : dict of str to array, shape (n,)
        Columns COLUMNS of the rows of table `galaxies` from which the pair was drawn.
    pair : Pair
        The pair.

    Returns
    -------
    Lens, Disc
        The mass of the lens has the position angle of its light. The source is at a random place in the circle with the
        Einstein radius around the lens.
    """
    _, shape_deviate, area_fraction, angle_fraction = pair.numbers.tolist()
    q = float(np.clip(law.axis_ratio + law.axis_ratio_scatter * shape_deviate, *law.axis_ratio_limits))
    offset, phi = pair.radius * np.sqrt(area_fraction), 2.0 * np.pi * angle_fraction
    size = max(float(columns["disk_half_light_radius"][pair.source]), 0.01)
    axis_ratio, angle = float(columns["disk_axis_ratio"][pair.source]), float(columns["position_angle"][pair.source])
    disc = Disc(float(offset * np.cos(phi)), float(offset * np.sin(phi)), size, axis_ratio, angle)
    return Lens(pair.radius, q, float(columns["position_angle"][pair.lens])), disc


def _side(stamp_settings: Stamps, lens: Lens, source: Disc) -> int:
    """Return the side of the image in pixels, an even number within the limits of `stamp_settings`.

    Half a side covers twice the Einstein radius along the major axis plus four half-light radii of the source.
    """
    reach = 2.0 * lens.radius / np.sqrt(lens.axis_ratio) + 4.0 * source.radius
    return int(np.clip(2 * np.ceil(reach / stamp_settings.pixel_scale), *stamp_settings.sides))


def _table(cell: int, columns: dict[str, Array], rows: list[Any], boost: float) -> pa.Table:
    identifiers = ids.hashed_id(STRONG_LENS, cell, np.array([row[0].key for row in rows], np.uint64))
    lens, source = (np.array([getattr(row[0], name) for row in rows], np.int64) for name in ("lens", "source"))
    order = np.lexsort((identifiers, columns["_healpix_29"][lens]))
    identifiers, lens, source, rows = identifiers[order], lens[order], source[order], [rows[i] for i in order]
    n = len(rows)
    position_columns = ("ra", "dec", "_healpix_29", "ra_true", "dec_true")

    def column_of(value: Any) -> Array:
        return np.array([value(row) for row in rows], float)

    return STRONG_LENSES.build(
        {
            "id": identifiers,
            **{name: columns[name][lens] for name in position_columns},
            "kind": np.full(n, STRONG_LENS),
            "lens_id": columns["id"][lens],
            "source_id": columns["id"][source],
            "density_boost": np.full(n, boost),
            "z_lens": columns["z_true"][lens],
            "z_source": columns["z_true"][source],
            "velocity_dispersion": column_of(lambda row: row[0].sigma),
            "einstein_radius": column_of(lambda row: row[1].radius),
            "axis_ratio": column_of(lambda row: row[1].axis_ratio),
            "position_angle": column_of(lambda row: row[1].angle),
            "source_east": column_of(lambda row: row[2].east),
            "source_north": column_of(lambda row: row[2].north),
            "images": column_of(lambda row: max(1, len(image_positions(row[1], row[2].east, row[2].north)))).astype(
                int
            ),
            "magnification": column_of(lambda row: row[4]),
            "stamp_side": column_of(lambda row: row[3].shape[0]).astype(int),
            "stamp": pa.array([row[3].ravel() for row in rows], STRONG_LENSES.column("stamp").arrow_type),
        }
    )


def _to_axes(angle: float, east: Float, north: Float) -> tuple[Float, Float]:
    """Return the components of vectors (east, north) along and across an axis with a position angle in deg."""
    sin, cos = np.sin(np.radians(angle)), np.cos(np.radians(angle))
    return east * sin + north * cos, east * cos - north * sin


def _from_axes(angle: float, along: Float, across: Float) -> tuple[Float, Float]:
    sin, cos = np.sin(np.radians(angle)), np.cos(np.radians(angle))
    return along * sin + across * cos, along * cos - across * sin


def _brightness(source: Disc, east: Float, north: Float) -> Float:
    along, across = _to_axes(source.angle, east - source.east, north - source.north)
    r = np.hypot(along, across / source.axis_ratio) / source.radius
    return np.asarray(_B**2 / (2.0 * np.pi * source.axis_ratio * source.radius**2) * np.exp(-_B * r))
