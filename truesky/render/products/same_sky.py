"""Draw one patch of sky as several cameras observe it, with north up, and as a colour image.

References
----------
Serrano et al. 2024, the figure of the pilot phase's field; Lupton et al. 2004 (colours)
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

# Side of a patch in arcsec; pixels of a picture, and of the larger colour picture.
SIDE, _PIXELS, _COLOUR_PIXELS = 100.0, 440, 1000
# Each camera is shown in the band closest to this wavelength in A, the longest that silicon detects.
_WAVELENGTH = 9000.0
# Number of trial positions of a patch along the side of a detector.
_GRID_SIZE = 9
# Red, green, blue: the first set of which the lake has all bands.
_COLOURS = (("euclid_h", "euclid_y", "euclid_vis"), ("lsst_i", "lsst_r", "lsst_g"), ("des_i", "des_r", "des_g"))
# Black (sigma below the sky), start of the logarithmic range, and white (sigma above the sky).
_BLACK, _KNEE, _WHITE = -1.5, 4.0, 150.0
# Distance from the median of a normal distribution to its quartile, in sigma.
_QUARTILE = 0.6745
# Colour picture: softening of the stretch, and signal in sigma that is shown at half of white.
_SOFTENING, _STRETCH = 8.0, 12.0
_INK, _PAPER = "#e8e6df", "#0b0d12"
_COLUMNS, _INCHES, _DPI = 3, (13.2, 9.35), 100

Row = dict[str, Any]


def draw(root: Path, out: Path, request: str | None = None) -> list[Path]:
    """Draw `same_sky.png` if more than two cameras share a patch, and `colour.png` if three bands do.

    Parameters
    ----------
    root : Path
        Root of the lake.
    out : Path
        Folder of the PNG files.
    request : str, optional
        Name of the request; required if the lake has several.

    Returns
    -------
    list of Path
        The PNG files.
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
    """Return the pixels of a patch of side SIDE about a position, with north up and east to the left.

    Parameters
    ----------
    file : Path
        An image file.
    place : tuple of float
        ICRS ra and dec in degrees.
    pixels : int
        Pixels along each side of the patch.
    order : int
        Order of the spline interpolation; 0 takes the nearest pixel.

    Returns
    -------
    float array, shape (pixels, pixels)
        Electrons; NaN outside the image.
    """
    image = read_back.electrons(file)
    data = np.asarray(image.data, float)
    step = SIDE * ((np.arange(pixels) + 0.5) / pixels - 0.5)
    # The x axis points west in a plane without rotation, like u.
    across, up = np.meshgrid(step, step)
    ra, dec = pointing.sky_of_plane(across.ravel(), up.ravel(), *place, 0.0)
    column, row = astrometry.pixel_of_sky(astrometry.from_cards(image.cards), ra, dec)
    values = map_coordinates(data, [row, column], order=order, mode="constant", cval=np.nan)
    return np.asarray(values.reshape(pixels, pixels))


def colours(red: Float, green: Float, blue: Float) -> Array:
    """Combine three images into a colour picture.

    Parameters
    ----------
    red, green, blue : float array, shape (ny, nx)
        Fluxes above the sky in units of the noise of each image.

    Returns
    -------
    uint8 array, shape (ny, nx, 3)
        RGB values.
    """
    from astropy.visualization import make_lupton_rgb

    layers = [np.nan_to_num(layer) for layer in (red, green, blue)]
    return np.asarray(make_lupton_rgb(*layers, minimum=-1.0, stretch=_STRETCH, Q=_SOFTENING))


def _rows(root: Path, request: str | None) -> list[Row]:
    """Return the science images of the sky with their footprints and exposures."""
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
    """Return the distance (A) between the wavelength of a band and _WAVELENGTH."""
    return abs(passbands.pivot_wavelength(passbands.load(row["band"])) - _WAVELENGTH)


def _camera(row: Row) -> tuple[str, str]:
    return row["channel"], row["camera"]


def _best_place(rows: Sequence[Row], cameras: Sequence[tuple[str, str]]) -> tuple[float, float]:
    """Return the position whose patch most cameras observe completely.

    Candidates lie on a grid over each detector of the camera with the fewest images.
    """
    rows_by_camera = {camera: [row for row in rows if _camera(row) == camera] for camera in cameras}
    fewest = rows_by_camera[min(cameras, key=lambda camera: (len(rows_by_camera[camera]), camera))]
    step = np.linspace(-1.0, 1.0, _GRID_SIZE) * 3600.0 * max(row["radius"] for row in fewest) / np.sqrt(2.0)
    across, up = (axis.ravel() for axis in np.meshgrid(step, step))
    candidates = [pointing.sky_of_plane(across, up, row["ra"], row["dec"], 0.0) for row in fewest]
    ra, dec = (np.concatenate([place[i] for place in candidates]) for i in (0, 1))
    corners = _corners(ra, dec)
    n_cameras = np.sum([_contains_patch(rows_by_camera[camera], corners) for camera in cameras], axis=0)
    # Ties are resolved by the distance from the centre of the detector.
    distance = np.tile(np.hypot(across, up), len(fewest))
    best = int(np.lexsort((distance, -n_cameras))[0])
    return float(ra[best]), float(dec[best])


def _corners(ra: Float, dec: Float) -> Float:
    """Return the corners (ra, dec in deg), shape (n, 4, 2), of patches about positions."""
    half = 0.5 * SIDE
    x, y = np.array([-half, half, -half, half]), np.array([-half, -half, half, half])
    return np.array([np.transpose(pointing.sky_of_plane(x, y, a, d, 0.0)) for a, d in zip(ra, dec, strict=True)])


def _contains_patch(rows: Sequence[Row], corners: Float) -> Int:
    """Return for each patch, shape (n), 1 if one of the images contains it completely, otherwise 0."""
    flat = corners.reshape(-1, 2)
    contained = np.zeros(len(corners), bool)
    for row in rows:
        contained |= (footprints.counts(_footprint(row), flat[:, 0], flat[:, 1]).reshape(-1, 4) > 0).all(axis=1)
    return contained.astype(np.int64)


def _rows_with_patch(place: tuple[float, float], rows: Sequence[Row]) -> list[Row]:
    """Return the images that contain the patch about a position completely."""
    corners = _corners(np.array([place[0]]), np.array([place[1]]))
    return [row for row in rows if _contains_patch([row], corners)[0]]


def _footprint(row: Row) -> pa.Table:
    return pa.Table.from_pylist([{name: row[name] for name in ("ra", "dec", "radius", "s_region")}])


def _sky_and_noise(image: Float) -> tuple[float, float]:
    """Return sky and noise, from the median and the lower quartile.

    Few pixels lie in gaps between detectors or are hit by cosmic rays.
    """
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
    """Draw the median of each band's exposures; with three or more, it is free of cosmic rays."""
    from matplotlib.image import imsave

    layers = []
    for rows in bands.values():
        # Scale to the flux of an AB magnitude, equal in all bands.
        scale = [10.0 ** (-0.4 * row["zero_point"]) / row["exposure_time_s"] for row in rows]
        patches = [patch(row["file"], place, _COLOUR_PIXELS, order=1) for row in rows]
        above = np.sort([s * (p - _sky_and_noise(p)[0]) for s, p in zip(scale, patches, strict=True)], axis=0)
        # For two exposures, take the lower value.
        layers.append(above[(len(above) - 1) // 2])
    picture = colours(*(layer / _sky_and_noise(layer)[1] for layer in layers))
    path.parent.mkdir(parents=True, exist_ok=True)
    imsave(path, picture, origin="lower")
    return path
