"""Select the bright sources that are labelled in the preview picture of an image, and the galaxies that it enlarges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.polynomial import polynomial

from lake_schema import sky, units
from lake_schema.arrays import Float, Int
from lake_schema.fits import images
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import read
from truesky.render.camera import astrometry

if TYPE_CHECKING:
    pass

# Largest number of galaxies that are labelled in a preview picture, and largest number of labelled stars. The brightest
# sources are labelled.
LABELS = 8
# Largest number of close-ups (enlarged galaxies) in a preview picture.
CLOSE_UPS = 3
# Height of a close-up (picture of an enlarged galaxy), arcsec.
CLOSE_UP_ARCSEC = 14.0
# Number of pixels that a close-up of a dispersed spectrum shows around the trace of the first order.
TRACE_MARGIN = 10
# Number of points of a trace at which its extent is computed.
_TRACE_SAMPLES = 33
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
    box : tuple of float, optional
        First and last column, first and last row of the trace of the first order in an image behind a grism. The
        position (column, row) is then the middle of the trace.
    """

    column: float
    row: float
    kind: str
    mag: float
    text: str
    box: tuple[float, float, float, float] | None = None


def labels(
    root: Path,
    product: dict[str, Any],
    image: images.Image,
    input_keys: Mapping[str, str],
    spectra: pa.Table | None = None,
) -> list[Label]:
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
    spectra : pyarrow.Table, optional
        Rows of the table `rendered_spectra` of the image. If given, only sources with a first order are labelled, at
        the middle of its trace.

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
    traces = None if spectra is None else _first_orders(spectra)
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
            rows, in_flux = rows.filter(in_view), flux[column].to_numpy()[in_view]
            if traces is None:
                place = astrometry.pixel_of_sky(system, *(rows[name].to_numpy() for name in ("ra", "dec")))
            else:
                place = _middles(rows["id"].to_numpy(), traces)
            candidates += _labels_of(kind, rows, in_flux, place, (ny, nx), traces or {})
    return sorted(candidates, key=lambda label: label.mag)


def _first_orders(spectra: pa.Table) -> dict[int, tuple[float, float, float, float]]:
    """Return first and last column, first and last row of the first order of each source, with a margin."""
    t = np.linspace(0.0, 1.0, _TRACE_SAMPLES)
    boxes = {}
    for trace in spectra.filter(pc.equal(spectra["order"], 1)).select(["id", "trace_x", "trace_y"]).to_pylist():
        x, y = (polynomial.polyval(t, np.array(trace[name])) for name in ("trace_x", "trace_y"))
        boxes[trace["id"]] = (
            float(x.min()) - TRACE_MARGIN,
            float(x.max()) + TRACE_MARGIN,
            float(y.min()) - TRACE_MARGIN,
            float(y.max()) + TRACE_MARGIN,
        )
    return boxes


def _middles(ids: Int, boxes: Mapping[int, tuple[float, float, float, float]]) -> tuple[Float, Float]:
    """Return column and row of the middle of the trace of each source, NaN for a source without a trace."""
    nowhere = (np.nan,) * 4
    x0, x1, y0, y1 = np.array([boxes.get(source, nowhere) for source in ids.tolist()]).T
    return (x0 + x1) / 2, (y0 + y1) / 2


def _labels_of(
    kind: str,
    rows: pa.Table,
    flux: Float,
    place: tuple[Float, Float],
    shape: tuple[int, int],
    boxes: Mapping[int, tuple[float, float, float, float]],
) -> list[Label]:
    """Return labels of the brightest sources of a kind inside an image.

    Parameters
    ----------
    kind : str
        "galaxy" or "star".
    rows : pyarrow.Table
        Rows of the catalogue, with the column z_obs for galaxies.
    flux : float array, shape (n,)
        Flux density of each row in the band of the image, microjansky.
    place : tuple of two float arrays, shape (n,)
        Column and row of each source, pixels; NaN for a source that must not be labelled.
    shape : tuple of int
        Numbers of rows and columns of the image.
    boxes : mapping of int to tuple
        Box of the trace of each source by its identifier; empty without a grism.

    Returns
    -------
    list of Label
        The labels, brightest first.
    """
    column, row = place
    inside = np.flatnonzero((column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0]))
    brightest = inside[np.argsort(-flux[inside])[: 4 * LABELS]]
    column, row = column[brightest], row[brightest]
    boxes_of = [boxes.get(source) for source in rows["id"].to_numpy()[brightest].tolist()]
    mag = units.mag_of_f_nu(flux[brightest])
    z = rows["z_obs"].to_numpy()[brightest] if kind == "galaxy" else np.full(len(mag), np.nan)
    texts = [f"{m:.1f}" if np.isnan(zi) else f"{m:.1f}  z {zi:.2f}" for m, zi in zip(mag, z, strict=True)]
    return [
        Label(float(x), float(y), kind, float(m), text, box)
        for x, y, m, text, box in zip(column, row, mag, texts, boxes_of, strict=True)
    ]


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
        At most CLOSE_UPS galaxies, brightest first. If the labels have traces, galaxies whose traces lie in the image.
    """
    traces = [x for x in names if x.kind == "galaxy" and x.box is not None and _is_inside(x.box, shape)]
    if traces:
        widths, heights = ([x.box[k + 1] - x.box[k] for x in traces if x.box] for k in (0, 2))
        return without_overlaps(traces, max(widths), max(heights), CLOSE_UPS)
    half = CLOSE_UP_ARCSEC / pixel_scale / 2
    inside = [
        x
        for x in names
        if x.box is None and x.kind == "galaxy" and half < x.column < shape[1] - half and half < x.row < shape[0] - half
    ]
    return without_overlaps(inside, 2 * half, 2 * half, CLOSE_UPS)


def _is_inside(box: tuple[float, float, float, float], shape: tuple[int, ...]) -> bool:
    return box[0] >= 0 and box[1] < shape[1] and box[2] >= 0 and box[3] < shape[0]
