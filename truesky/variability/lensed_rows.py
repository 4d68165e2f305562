"""Make the rows of the table `lensed_images` from strong lenses and the point sources behind them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from lake_schema import ids, sky
from lake_schema.arrays import Array, Float, Int
from lake_schema.ids import GENERATION_ORDER
from lake_schema.tables.variability.lensed_images import LENSED_IMAGES, SUPERNOVA
from truesky.cosmology import Cosmology
from truesky.randomness import per_source
from truesky.variability import lensed_images
from truesky.variability.lensed_images import Ellipsoids

# Columns of the table `transients` on which light curves depend, and all columns that are needed.
LIGHT_COLUMNS = tuple(column.name for column in SUPERNOVA)
TRANSIENT_COLUMNS = ("id", "host_id", "offset_east", "offset_north", "density_boost", *LIGHT_COLUMNS)
# Columns of the table `strong_lenses` that are needed. The first are copied to the images.
_COPIED = ("lens_id", "z_lens", "z_source")
LENS_COLUMNS = (
    "id", *_COPIED, "source_id", "density_boost", "ra", "dec", "einstein_radius", "axis_ratio", "position_angle",
    "source_east", "source_north",
)  # fmt: skip
_ARCSEC = np.pi / 180.0 / 3600.0


@dataclass(frozen=True, slots=True, eq=False)
class PointSources:
    """Point sources in the galaxies behind strong lenses.

    Attributes
    ----------
    ids : int64 array, shape (n,)
        Identifiers of the sources.
    host_ids : int64 array, shape (n,)
        Identifiers of their galaxies, of which some are behind a strong lens. A quasar is its own host.
    east, north : float array, shape (n,)
        Distances from the centre of the host without lensing, arcsec.
    density_boost : float array, shape (n,)
        Factor by which the sources were drawn denser than in nature.
    light : mapping of str to array, shape (n,)
        Columns LIGHT_COLUMNS of supernovae; empty for quasars.
    """

    ids: Int
    host_ids: Int
    east: Float
    north: Float
    density_boost: Float
    light: Mapping[str, Array]


def transients(rows: pa.Table) -> PointSources:
    """Return the point sources of rows of the table `transients` with the columns TRANSIENT_COLUMNS."""
    columns = {name: rows[name].to_numpy() for name in TRANSIENT_COLUMNS}
    return PointSources(
        columns["id"],
        columns["host_id"],
        columns["offset_east"],
        columns["offset_north"],
        columns["density_boost"],
        {name: columns[name] for name in LIGHT_COLUMNS},
    )


def image_rows(lenses: Mapping[str, Array], sources: PointSources, cosmology: Cosmology) -> pa.Table:
    """Make the rows of the table `lensed_images`.

    Parameters
    ----------
    lenses : mapping of str to array, shape (m,)
        Columns LENS_COLUMNS of the table `strong_lenses`, in any order of the rows.
    sources : PointSources
        The sources, in any order. Sources in galaxies that are not behind a lens are ignored.
    cosmology : Cosmology
        Parameters of the universe.

    Returns
    -------
    pyarrow.Table
        One row per image, sorted by the order-29 cell of its position, then by identifier. A source whose host is
        behind several lenses has images at each of them. A row does not depend on other lenses and sources.

    Raises
    ------
    BadInput
        If a source is not behind its lens, or a lens has no mass or an impossible shape.

    Notes
    -----
    The image of the host is not turned, so the offset of a source from the centre of its host adds to the place of the
    host behind the lens. Weak lensing of the source at its own place is left out, as for the arcs of its host.
    """
    lens, source = _pairs(lenses["source_id"], sources.host_ids)
    row = {name: np.asarray(lenses[name])[lens] for name in LENS_COLUMNS}
    ellipsoids = Ellipsoids(*(row[name].astype(float) for name in ("einstein_radius", "axis_ratio", "position_angle")))
    east = row["source_east"].astype(float) + np.asarray(sources.east, float)[source]
    north = row["source_north"].astype(float) + np.asarray(sources.north, float)[source]
    images = lensed_images.find_images(ellipsoids, east, north)
    # From here on, all arrays have one element per image.
    row = {name: values[images.source] for name, values in row.items()}
    source = source[images.source]
    source_ids = sources.ids[source]
    delay = lensed_images.delays(images.lag, row["z_lens"], row["z_source"], cosmology)
    light = {name: values[source] for name, values in sources.light.items()}
    if "peak_mjd" in light:
        light["peak_mjd"] = light["peak_mjd"] + delay
    ra, dec = sky.offset_positions(row["ra"], row["dec"], images.east * _ARCSEC, images.north * _ARCSEC)
    rows = LENSED_IMAGES.build(
        {
            "id": _identifiers(row, source_ids, images.number),
            "ra": ra,
            "dec": dec,
            "_healpix_29": sky.healpix_29(ra, dec),
            "source_id": source_ids,
            "system_id": row["id"],
            **{name: row[name] for name in _COPIED},
            "density_boost": row["density_boost"] * np.asarray(sources.density_boost)[source],
            "images": np.bincount(images.source, minlength=len(lens))[images.source],
            "image": images.number,
            "magnification": np.abs(images.magnification),
            "parity": np.sign(images.magnification).astype(int),
            "delay": delay,
            **light,
        }
    )
    return rows.sort_by([("_healpix_29", "ascending"), ("id", "ascending")])


def _pairs(lensed_hosts: Array, hosts: Int) -> tuple[Int, Int]:
    """Return the indices of all pairs of a lens and a source in the galaxy behind it."""
    order = np.argsort(lensed_hosts, kind="stable")
    first, last = (np.searchsorted(lensed_hosts, hosts, side, order) for side in ("left", "right"))
    count = last - first
    source = np.repeat(np.arange(len(hosts)), count)
    rank = np.arange(len(source)) - np.repeat(np.cumsum(count) - count, count)
    return order[first[source] + rank], source


def _identifiers(row: Mapping[str, Array], source_ids: Int, number: Int) -> Int:
    """Return the identifiers of images: 37 random bits of lens and source, and the number of the image."""
    words = per_source.keys(row["id"], "lensed_images", "lens") ^ per_source.keys(source_ids, "lensed_images", "source")
    words = words & ~np.uint64(3) | (number - 1).astype(np.uint64)
    return ids.transient_id(sky.cell_at(row["ra"], row["dec"], GENERATION_ORDER), words)
