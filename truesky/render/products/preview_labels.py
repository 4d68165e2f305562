"""Select the bright sources that are labelled in the preview picture of an image, and the galaxies that it enlarges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from astropy.wcs import WCS

from lake_schema import sky, units
from lake_schema.arrays import Float
from lake_schema.fits import images
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import read
from truesky.render.camera import astrometry

# Largest number of galaxies that are labelled in a preview picture, and largest number of labelled stars. The brightest
# sources are labelled.
LABELS = 8
# Largest number of close-ups (enlarged galaxies) in a preview picture.
CLOSE_UPS = 3
# Height of a close-up (picture of an enlarged galaxy), arcsec.
CLOSE_UP_ARCSEC = 14.0
# Width of a close-up (picture of an enlarged galaxy) on the sky divided by its height.
CLOSE_UP_SHAPE = 1.145


@dataclass(frozen=True, slots=True)
class Label:
    """Label of a source in the preview picture of an image.

    Attributes
    ----------
    column, row : float
        Pixel position of the source, counted from 0.
    kind : str
        "galaxy" or "star".
    mag : float
        AB magnitude in the band of the image.
    text : str
        Text of the label: magnitude, and redshift of a galaxy.
    """

    column: float
    row: float
    kind: str
    mag: float
    text: str


def labels(root: Path, product: dict[str, Any], image: images.Image, input_keys: Mapping[str, str]) -> list[Label]:
    """Return labels for the brightest galaxies and stars inside an image.

    Parameters
    ----------
    root : Path
        Lake (folder of stored tables and images).
    product : dict
        Row of the table `products` for the image.
    image : Image
        Pixels and FITS header of the image, with its WCS.
    input_keys : mapping of str to str
        Version (hash) of each table from which the image was made, by table name.

    Returns
    -------
    list of Label
        At most 32 galaxies and 32 stars, brightest first. They may overlap.
    """
    system = astrometry.from_cards(image.cards)
    ny, nx = np.asarray(image.data).shape
    column = f"f_nu_{product['band']}"
    centre = (product["ra"], product["dec"])
    corner = astrometry.sky_of_pixel(system, [-0.5], [-0.5])
    radius = float(sky.separation(*centre, *corner)[0])
    cells = sky.cells_in_cone(*centre, radius, GENERATION_ORDER).tolist()
    candidates: list[Label] = []
    for kind, table in (("galaxy", "galaxies"), ("star", "stars")):
        version = read.version(root, table, input_keys[table])
        columns = ["id", "ra", "dec"] + (["z_obs"] if kind == "galaxy" else [])
        rows = version.rows_in_cells(cells, GENERATION_ORDER, columns)
        fluxes = read.version(root, f"{kind}_fluxes", input_keys[f"{kind}_fluxes"])
        flux = fluxes.rows_in_cells(cells, GENERATION_ORDER, ["id", column])
        in_view = sky.separation(*centre, *(rows[name].to_numpy() for name in ("ra", "dec"))) < radius
        in_view &= flux[column].to_numpy() > 0
        if in_view.any():
            candidates += _labels_of(kind, rows.filter(in_view), flux[column].to_numpy()[in_view], system, (ny, nx))
    return sorted(candidates, key=lambda label: label.mag)


def _labels_of(kind: str, rows: pa.Table, flux: Float, system: WCS, shape: tuple[int, int]) -> list[Label]:
    column, row = astrometry.pixel_of_sky(system, *(rows[name].to_numpy() for name in ("ra", "dec")))
    inside = np.flatnonzero((column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0]))
    brightest = inside[np.argsort(-flux[inside])[: 4 * LABELS]]
    column, row = column[brightest], row[brightest]
    mag = units.mag_of_f_nu(flux[brightest])
    z = rows["z_obs"].to_numpy()[brightest] if kind == "galaxy" else np.full(len(mag), np.nan)
    texts = [f"{m:.1f}" if np.isnan(zi) else f"{m:.1f}  z {zi:.2f}" for m, zi in zip(mag, z, strict=True)]
    return [Label(float(x), float(y), kind, float(m), t) for x, y, m, t in zip(column, row, mag, texts, strict=True)]


def without_overlaps(names: Sequence[Label], width: float, height: float, max_per_kind: int) -> list[Label]:
    """Select labels that do not overlap, beginning with the brightest source.

    Parameters
    ----------
    names : sequence of Label
        Labels, brightest first.
    width, height : float
        Size of the space for a label in pixels.
    max_per_kind : int
        Largest number of galaxies, and largest number of stars.

    Returns
    -------
    list of Label
        The selected labels, brightest first.
    """
    accepted: list[Label] = []
    for label in names:
        free = all(abs(label.column - x.column) > width or abs(label.row - x.row) > height for x in accepted)
        if free and sum(x.kind == label.kind for x in accepted) < max_per_kind:
            accepted.append(label)
    return accepted


def close_ups(names: Sequence[Label], shape: tuple[int, ...], pixel_scale: float) -> list[Label]:
    """Select the brightest galaxies for close-ups, which must lie well inside the image and not overlap.

    Parameters
    ----------
    names : sequence of Label
        Labels of galaxies and stars, brightest first.
    shape : tuple of int
        Numbers of rows and columns of the image.
    pixel_scale : float
        Arcsec per pixel.

    Returns
    -------
    list of Label
        At most CLOSE_UPS galaxies, brightest first.
    """
    half = CLOSE_UP_ARCSEC / pixel_scale / 2
    inside = [
        x for x in names if x.kind == "galaxy" and half < x.column < shape[1] - half and half < x.row < shape[0] - half
    ]
    return without_overlaps(inside, 2 * half, 2 * half, CLOSE_UPS)
