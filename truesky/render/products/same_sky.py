"""One patch of the sky as several cameras see it, north up; and in colour.

draw      pictures of the patch that most cameras of a lake share
patch     a lake's images of one place -> pixels of one grid, camera by camera
colours   three bands of it -> an image in colour

Ref : Serrano et al. 2024, the figure of the pilot phase's field; Lupton et al. 2004 (colours)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from scipy.ndimage import map_coordinates

from lake_schema.arrays import Array, Float, Int
from lake_schema.store import read
from lake_schema.tables.exposures import CHANNELS
from truesky.fluxes import passbands
from truesky.render.camera import astrometry, footprints, pointing
from truesky.render.planning.exposure_chunks import rows_of_exposures
from truesky.render.products import read_back

# Side of a patch, arcsec, and pixels of a picture of it; that of the colours is larger.
SIDE, _PIXELS, _COLOUR_PIXELS = 100.0, 440, 1000
# Of each camera the band is shown whose wavelength is nearest to this, A: the longest that silicon sees.
_WAVELENGTH = 9000.0
# Places that are tried for a patch, along a side of a detector.
_GRID_SIZE = 9
# Red, green, blue: the first of these that the lake has.
_COLOURS = (("euclid_h", "euclid_y", "euclid_vis"), ("lsst_i", "lsst_r", "lsst_g"), ("des_i", "des_r", "des_g"))
# Shown from black to white: sigma below the sky, where logarithmic begins, sigma above.
_BLACK, _KNEE, _WHITE = -1.5, 4.0, 150.0
# From the median of a normal distribution to its quartile, in sigma.
_QUARTILE = 0.6745
# Of the colours: the softening of their stretch, and sigma that are half of white.
_SOFTENING, _STRETCH = 8.0, 12.0
_INK, _PAPER = "#e8e6df", "#0b0d12"
_COLUMNS, _INCHES, _DPI = 3, (13.2, 9.35), 100

Row = dict[str, Any]


def draw(root: Path, out: Path, request: str | None = None) -> list[Path]:
    """`same_sky.png` where more than two cameras share a patch, `colour.png` where three bands do; their paths.

    root : of the lake;  out : folder;  request : its name, where the lake has several
    """
    rows = _rows(root, request)
    order = [channel for channel, _ in CHANNELS]
    cameras = sorted({_camera(row) for row in rows}, key=lambda camera: (order.index(camera[0]), camera))
    if len(cameras) < 3:
        return []
    place = _best_place(rows, cameras)
    paths = []
    panels = []
    for camera in cameras:
        if candidates := _rows_with_patch(place, [row for row in rows if _camera(row) == camera]):
            row = min(candidates, key=lambda row: (_wavelength_offset(row), row["exposure_id"]))
            panels.append((row, patch(row["file"], place, _PIXELS, order=0)))
    if len(panels) > 2:
        paths.append(_draw_panels(out / "same_sky.png", panels, place))
    bands: dict[str, list[Row]] = {}
    for row in _rows_with_patch(place, rows):
        bands.setdefault(row["band"], []).append(row)
    for names in _COLOURS:
        if all(name in bands for name in names):
            paths.append(_draw_colours(out / "colour.png", {name: bands[name] for name in names}, place))
            break
    return paths


def patch(file: Path, place: tuple[float, float], pixels: int, order: int) -> Float:
    """[pixels, pixels] electrons of a patch about a place, east to the left; nan where the image has none.

    file  : an image;  place : ra, dec deg;  order : of the interpolation, 0 = the pixel that lies there
    """
    image = read_back.electrons(file)
    data = np.asarray(image.data, float)
    step = SIDE * ((np.arange(pixels) + 0.5) / pixels - 0.5)
    # x points west in a plane without rotation, as u does.
    across, up = np.meshgrid(step, step)
    ra, dec = pointing.sky_of_plane(across.ravel(), up.ravel(), *place, 0.0)
    column, row = astrometry.pixel_of_sky(astrometry.from_cards(image.cards), ra, dec)
    values = map_coordinates(data, [row, column], order=order, mode="constant", cval=np.nan)
    return np.asarray(values.reshape(pixels, pixels))


def colours(red: Float, green: Float, blue: Float) -> Array:
    """[ny, nx] fluxes above the sky, each in sigma of its own -> uint8[ny, nx, 3]."""
    from astropy.visualization import make_lupton_rgb

    layers = [np.nan_to_num(layer) for layer in (red, green, blue)]
    return np.asarray(make_lupton_rgb(*layers, minimum=-1.0, stretch=_STRETCH, Q=_SOFTENING))


def _rows(root: Path, request: str | None) -> list[Row]:
    """Science images of the sky with their footprints and exposures."""
    version = read.version(root, "products", request=request)
    inputs = version.manifest["facts"]["inputs"]
    product_rows = version.rows()
    numbers = product_rows["exposure_id"].unique().to_pylist()
    planned = (rows_of_exposures(read.version(root, name, inputs[name]), numbers) for name in ("tasks", "exposures"))
    task_rows, exposure_rows = (table.to_pylist() for table in planned)
    tasks = {(task["exposure_id"], task["detector"]): task for task in task_rows}
    exposures = {row["exposure_id"]: row for row in exposure_rows}
    image_rows = []
    for row in product_rows.to_pylist():
        exposure = exposures[row["exposure_id"]]
        if row["content"] == "science" and exposure["image_type"] in ("science", "deep"):
            task = tasks[row["exposure_id"], row["detector"]]
            image_rows.append({**exposure, **task, "file": version.sidecar_path(row["path"])})
    return image_rows


def _wavelength_offset(row: Row) -> float:
    """A between its band and the one that is shown of each camera."""
    return abs(passbands.pivot_wavelength(passbands.load(row["band"])) - _WAVELENGTH)


def _camera(row: Row) -> tuple[str, str]:
    return row["channel"], row["camera"]


def _best_place(rows: Sequence[Row], cameras: Sequence[tuple[str, str]]) -> tuple[float, float]:
    """The place whose patch most cameras see whole: of a grid over the detectors of the camera with the fewest."""
    rows_by_camera = {camera: [row for row in rows if _camera(row) == camera] for camera in cameras}
    fewest = rows_by_camera[min(cameras, key=lambda camera: (len(rows_by_camera[camera]), camera))]
    step = np.linspace(-1.0, 1.0, _GRID_SIZE) * 3600.0 * max(row["radius"] for row in fewest) / np.sqrt(2.0)
    across, up = (axis.ravel() for axis in np.meshgrid(step, step))
    candidates = [pointing.sky_of_plane(across, up, row["ra"], row["dec"], 0.0) for row in fewest]
    ra, dec = (np.concatenate([place[i] for place in candidates]) for i in (0, 1))
    corners = _corners(ra, dec)
    n_cameras = np.sum([_contains_patch(rows_by_camera[camera], corners) for camera in cameras], axis=0)
    # Of several the one nearest to a detector's middle.
    distance = np.tile(np.hypot(across, up), len(fewest))
    best = int(np.lexsort((distance, -n_cameras))[0])
    return float(ra[best]), float(dec[best])


def _corners(ra: Float, dec: Float) -> Float:
    """[n, 4, 2] ra, dec deg of the patches about places."""
    half = 0.5 * SIDE
    x, y = np.array([-half, half, -half, half]), np.array([-half, -half, half, half])
    return np.array([np.transpose(pointing.sky_of_plane(x, y, a, d, 0.0)) for a, d in zip(ra, dec, strict=True)])


def _contains_patch(rows: Sequence[Row], corners: Float) -> Int:
    """[n] 1 where one of the images has the whole patch of these corners, else 0."""
    flat = corners.reshape(-1, 2)
    contained = np.zeros(len(corners), bool)
    for row in rows:
        contained |= (footprints.counts(_footprint(row), flat[:, 0], flat[:, 1]).reshape(-1, 4) > 0).all(axis=1)
    return contained.astype(np.int64)


def _rows_with_patch(place: tuple[float, float], rows: Sequence[Row]) -> list[Row]:
    """The images that have the patch about a place whole."""
    corners = _corners(np.array([place[0]]), np.array([place[1]]))
    return [row for row in rows if _contains_patch([row], corners)[0]]


def _footprint(row: Row) -> pa.Table:
    return pa.Table.from_pylist([{name: row[name] for name in ("ra", "dec", "radius", "s_region")}])


def _sky_and_noise(image: Float) -> tuple[float, float]:
    """Sky and noise, from the median and the quartile below it: gaps between cells and cosmic rays are few."""
    finite = image[np.isfinite(image)]
    low, level = np.quantile(finite, (0.25, 0.5))
    return float(level), max(float(level - low) / _QUARTILE, 1e-12)


def _draw_panels(path: Path, panels: Sequence[tuple[Row, Float]], place: tuple[float, float]) -> Path:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    lines = -(-len(panels) // _COLUMNS)
    figure = Figure(figsize=(_INCHES[0], _INCHES[1] * lines / 2), dpi=_DPI, facecolor=_PAPER)
    FigureCanvasAgg(figure)
    for number, (row, image) in enumerate(panels):
        axes = figure.add_subplot(lines, _COLUMNS, number + 1)
        level, noise = _sky_and_noise(image)
        signal = np.clip((image - level) / noise, _BLACK, _WHITE)
        axes.imshow(np.arcsinh(signal / _KNEE), origin="lower", cmap="gray", interpolation="none")
        axes.set_axis_off()
        title = f"{row['camera'].upper()}   {row['band']}   {row['exposure_time_s']:.0f} s"
        axes.set_title(title, color=_INK, fontsize=11, pad=4)
    text = f'RA {place[0]:.4f}  Dec {place[1]:+.4f}   {SIDE:g}" x {SIDE:g}"   north up, east left'
    figure.text(0.5, 0.012, text, color=_INK, fontsize=10, ha="center")
    figure.subplots_adjust(0.005, 0.04, 0.995, 0.965, 0.015, 0.07)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, facecolor=_PAPER, metadata={"Software": None})
    return path


def _draw_colours(path: Path, bands: Mapping[str, Sequence[Row]], place: tuple[float, float]) -> Path:
    """The median of each band's exposures, in which no cosmic ray is left where there are three or more."""
    from matplotlib.image import imsave

    layers = []
    for rows in bands.values():
        # To the flux of an AB magnitude, the same in all bands.
        scale = [10.0 ** (-0.4 * row["zero_point"]) / row["exposure_time_s"] for row in rows]
        patches = [patch(row["file"], place, _COLOUR_PIXELS, order=1) for row in rows]
        above = np.sort([s * (p - _sky_and_noise(p)[0]) for s, p in zip(scale, patches, strict=True)], axis=0)
        # Of two the lower.
        layers.append(above[(len(above) - 1) // 2])
    picture = colours(*(layer / _sky_and_noise(layer)[1] for layer in layers))
    path.parent.mkdir(parents=True, exist_ok=True)
    imsave(path, picture, origin="lower")
    return path
