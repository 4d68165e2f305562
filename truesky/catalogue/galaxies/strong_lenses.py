"""Strong lenses: singular isothermal ellipsoids (SIE), and pictures of what lies behind them by inverse ray shooting.

draw            table `strong_lenses` from galaxies of one cell
deflection      of an SIE
shoot           the picture of an exponential disc behind it
image_positions where a point behind it is seen: roots of one equation in one angle, no rays

Lenses are all galaxies redder than the blue sequence: at 0.1 < z < 0.7 their dispersions have the fourth moment, which
is what cross-sections add up to, of Choi et al. 2007 within 15 %. Their number is that of Collett 2015 by his criteria
of detection: 10.2 +- 1.1 deg-2 of I_E < 26 and z < 2.3 behind them, against 11.3 (14.9 +- 1.3 in all). Centrals of
halos above 10^12.7 Msun/h alone would be a fifth of it: most lenses are galaxies of smaller halos.

Coordinates are arcsec east and north of the lens on the tangent plane. The pictures are of the smooth lens alone; the
weak lensing of what lies in front and behind is left out.
Ref: Kormann, Schneider & Bartelmann 1994, A&A 284, 285
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from scipy.optimize import brentq

from lake_schema import ids, sky
from lake_schema.arrays import Array, Float, Float32, Int
from lake_schema.ids import GENERATION_ORDER
from lake_schema.tables.strong_lenses import STRONG_LENSES
from lake_schema.units import LIGHT_KM_S
from truesky.catalogue import parameters
from truesky.catalogue.galaxies import lens_pairs
from truesky.catalogue.halos import luminosity_function
from truesky.fluxes import cosmology
from truesky.randomness import per_source
from truesky.randomness.per_source import PerSourceGenerator

COLUMNS = (
    "id", "kind", "ra", "dec", "_healpix_29", "ra_true", "dec_true", "z_true", "abs_mag_r01", "color_gr_01",
    "disk_half_light_radius", "disk_axis_ratio", "position_angle",
)  # fmt: skip
STRONG_LENS = 4
_FILE = "strong_lenses.toml"
# Share of the least magnification that one ray a pixel is sure to find.
_QUICK_SHARE = 0.7
# Of the exponential disc: half of its light is inside r = b h.
_B = 1.6783469900166605
# Angles in which sign changes are looked for: images closer than this merge at a caustic.
_ANGLE_COUNT = 4096
# Share of the sources that a lens is paired with; all of them where the boost makes the chance of each larger.
_WINDOW = 1.0 / 64.0


@dataclass(frozen=True, slots=True)
class Lens:
    """An SIE: Einstein radius, arcsec; minor / major axis; position angle of the major axis, deg."""

    radius: float
    axis_ratio: float
    angle: float


@dataclass(frozen=True, slots=True)
class Disc:
    """An exponential disc of flux 1 at (east, north): half-light semi-major axis, arcsec; axis ratio; deg."""

    east: float
    north: float
    radius: float
    axis_ratio: float
    angle: float


@dataclass(frozen=True, slots=True)
class Laws:
    """Which galaxies are lenses, and what of (strong_lenses.toml, [lenses])."""

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
    """Rows of lens and source; dispersion, km/s; Einstein radius, arcsec; key and numbers of the pair's own."""

    lens: int
    source: int
    sigma: float
    radius: float
    key: int
    numbers: Float


@dataclass(frozen=True, slots=True)
class Stamps:
    """How pictures are taken (strong_lenses.toml, [stamp])."""

    pixel_scale: float
    sides: tuple[int, int]
    samples: tuple[int, int]
    samples_a_radius: float


def laws() -> Laws:
    """The lenses of the embedded universe."""
    return Laws(**parameters.section(_FILE, "lenses"))


def stamps() -> Stamps:
    """How their pictures are taken."""
    return Stamps(**parameters.section(_FILE, "stamp"))


def draw(cell: int, galaxies: pa.Table, seed: int, boost: float) -> pa.Table:
    """Table `strong_lenses` of one order-8 cell.

    galaxies : the cell's rows of table `galaxies`, COLUMNS
    boost    : how many times denser than in nature; a source lies as probably within an Einstein radius of a lens as
               anywhere else on as much sky
    cell     : nested index at order 8;  seed : of the request
    """
    law, stamp_settings = laws(), stamps()
    columns = {name: galaxies[name].to_numpy() for name in COLUMNS}
    rows = []
    for pair in _pairs(law, columns, boost, sky.cell_area(GENERATION_ORDER) * 3600.0**2, seed):
        system = _system(law, columns, pair)
        side = _side(stamp_settings, *system)
        # A glance with few rays tells most of those that are too faint.
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


def einstein_radius(sigma: npt.ArrayLike, z_lens: npt.ArrayLike, z_source: npt.ArrayLike) -> Float:
    """Arcsec, of dispersions in km/s: 4 pi (sigma / c)^2 D_ls / D_s in a flat space; 0 where the source is in front.

    sigma : float[n] km/s;  z_lens, z_source : float[n]
    """
    ratio = 1.0 - cosmology.comoving_distance(z_lens) / cosmology.comoving_distance(z_source)
    return _max_einstein_radius(sigma) * np.maximum(ratio, 0.0)


def _max_einstein_radius(sigma: npt.ArrayLike) -> Float:
    """Of sources infinitely far behind."""
    return np.asarray(np.degrees(4.0 * np.pi * (np.asarray(sigma, float) / LIGHT_KM_S) ** 2) * 3600.0)


def deflection(lens: Lens, east: Float, north: Float) -> tuple[Float, Float]:
    """Deflection (east, north) of rays, arcsec: they come from (east, north) minus this.

    east, north : float[...] arcsec from the lens
    Ref: eqs. 27a, 27b
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
    """Of a point seen at (east, north), negative where it is mirrored: 1 / (1 - 2 kappa).

    east, north : float[...] arcsec from the lens
    """
    along, across = _to_axes(lens.angle, east, north)
    return np.asarray(1.0 / (1.0 - lens.radius * np.sqrt(lens.axis_ratio) / np.hypot(lens.axis_ratio * along, across)))


def image_positions(lens: Lens, east: float, north: float) -> Float:
    """[n, 2] where a point source is seen, (east, north) arcsec.

    The deflection of an SIE depends on the direction alone: an image in direction phi is at distance
    r = (beta + alpha(phi)) . e(phi) > 0, where (beta + alpha(phi)) x e(phi) = 0.
    """

    def across(phi: npt.ArrayLike) -> Any:
        e, n = np.cos(phi), np.sin(phi)
        x, y = deflection(lens, np.asarray(e), np.asarray(n))
        return (east + x) * n - (north + y) * e

    # An odd start: no image is expected exactly there.
    phi = 0.1234567 + np.linspace(0.0, 2.0 * np.pi, _ANGLE_COUNT + 1)
    values = across(phi)
    images = []
    for i in np.flatnonzero(values[:-1] * values[1:] < 0.0):
        root = brentq(across, phi[i], phi[i + 1], xtol=1e-13)
        direction = np.array([np.cos(root), np.sin(root)])
        bent = deflection(lens, direction[:1], direction[1:])
        distance = (east + bent[0][0]) * direction[0] + (north + bent[1][0]) * direction[1]
        if distance > 0.0:
            images.append(distance * direction)
    return np.array(images).reshape(-1, 2)


def shoot_rays(lens: Lens, source: Disc, stamp_settings: Stamps, side: int) -> Float32:
    """Picture [side, side] of a source of flux 1, south to north and west to east; its sum is the magnification.

    lens  : what deflects;  source : an exponential disc behind it
    shape : samples and pixel scale of pictures;  side : of this one, pixels
    Error: 1 % of the magnification (tests), for sources larger than a quarter of a pixel
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


# ------------------------------------------------------------------------------------------------ a cell


def _pairs(law: Laws, columns: dict[str, Array], boost: float, area: float, seed: int) -> list[Pair]:
    """What is drawn of lenses and the sources behind them; area : of the cell, arcsec2.

    A pair is drawn or not whichever others there are, so that a deeper catalogue has the same lenses, and more.
    """
    is_galaxy = columns["kind"] < 2
    lens = np.flatnonzero(is_galaxy & (columns["color_gr_01"] > law.reddest_blue) & (columns["z_true"] > 0.02))
    z_lens, rng = columns["z_true"][lens].astype(float), PerSourceGenerator(columns["id"][lens], seed, "strong_lenses")
    m_star, _, _ = luminosity_function.schechter().parameters_at(z_lens)
    brighter = m_star - columns["abs_mag_r01"][lens]
    sigma = law.sigma_star * 10.0 ** (0.1 * brighter + law.scatter * rng.standard_normal())
    # However far its source, a lens has no larger radius.
    max_radius = _max_einstein_radius(sigma)
    chance = boost * np.pi * max_radius**2 / area
    window = np.where(chance < _WINDOW, _WINDOW, 1.0)
    lenses = per_source.keys(columns["id"][lens], seed, "strong_lenses", "pair"), rng.random(), window, chance, z_lens

    source = np.flatnonzero(is_galaxy)
    place = PerSourceGenerator(columns["id"][source], seed, "strong_lenses", "source").random()
    source, place = source[np.argsort(place)], np.sort(place)
    source_keys = per_source.keys(columns["id"][source], seed, "strong_lenses", "source")
    sources = source_keys, place, columns["z_true"][source].astype(float)
    out = _allocate(0)
    while (count := lens_pairs.find_pairs(lenses, sources, law.least_z_apart, out)) > out[0].size:
        out = _allocate(count)
    radius = einstein_radius(sigma[out[0]], z_lens[out[0]], columns["z_true"][source[out[1]]])
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


def _system(law: Laws, columns: dict[str, Array], pair: Pair) -> tuple[Lens, Disc]:
    """Mass follows light in angle; the source lies anywhere within the Einstein radius."""
    _, shape_deviate, area_fraction, angle_fraction = pair.numbers.tolist()
    q = float(np.clip(law.axis_ratio + law.axis_ratio_scatter * shape_deviate, *law.axis_ratio_limits))
    offset, phi = pair.radius * np.sqrt(area_fraction), 2.0 * np.pi * angle_fraction
    size = max(float(columns["disk_half_light_radius"][pair.source]), 0.01)
    axis_ratio, angle = float(columns["disk_axis_ratio"][pair.source]), float(columns["position_angle"][pair.source])
    disc = Disc(float(offset * np.cos(phi)), float(offset * np.sin(phi)), size, axis_ratio, angle)
    return Lens(pair.radius, q, float(columns["position_angle"][pair.lens])), disc


def _side(stamp_settings: Stamps, lens: Lens, source: Disc) -> int:
    """Twice the Einstein radius and several radii of the source fit in, as far as stamps go."""
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
    """(along the major axis, across it)."""
    sin, cos = np.sin(np.radians(angle)), np.cos(np.radians(angle))
    return east * sin + north * cos, east * cos - north * sin


def _from_axes(angle: float, along: Float, across: Float) -> tuple[Float, Float]:
    sin, cos = np.sin(np.radians(angle)), np.cos(np.radians(angle))
    return along * sin + across * cos, along * cos - across * sin


def _brightness(source: Disc, east: Float, north: Float) -> Float:
    along, across = _to_axes(source.angle, east - source.east, north - source.north)
    r = np.hypot(along, across / source.axis_ratio) / source.radius
    return np.asarray(_B**2 / (2.0 * np.pi * source.axis_ratio * source.radius**2) * np.exp(-_B * r))
