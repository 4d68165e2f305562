"""Draw one small patch of sky as several cameras observe it, with north up, and as a colour image.

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
import scipy

from lake_schema.arrays import Array, Float, Int
from lake_schema.store import read
from lake_schema.tables.exposures import CHANNELS
from truesky.fluxes import passbands
from truesky.render.camera import astrometry, footprints, pointing
from truesky.render.planning.exposure_chunks import rows_of_exposures
from truesky.render.products import read_back

# Side of the patch of sky that is drawn for all cameras, arcsec.
SIDE = 100.0
# Pixels along a side of the picture of the patch in one camera.
_PIXELS = 440
# Pixels along a side of the colour picture of the patch.
_COLOUR_PIXELS = 1000
# Each camera is shown in the band whose wavelength is closest to this value, Angstrom. Silicon detectors and infrared
# cameras both have bands near it.
_WAVELENGTH = 9000.0
# Number of trial positions along each side of an image. At each, the cameras that observe a whole patch of sky are
# counted.
_GRID_SIZE = 9
# Sets of bands shown as red, green and blue. The first set is used of which the patch has been observed in all bands.
_COLOURS = (("euclid_h", "euclid_y", "euclid_vis"), ("lsst_i", "lsst_r", "lsst_g"), ("des_i", "des_r", "des_g"))
# Signal above the sky, in rms noise of a sky pixel, that the picture of a camera shows in black.
_BLACK = -1.5
# Signal above the sky, in rms noise of a sky pixel, up to which the brightness of the picture is about linear in the
# signal. Above it, the brightness is logarithmic.
_KNEE = 4.0
# Signal above the sky, in rms noise of a sky pixel, that the picture of a camera shows in white.
_WHITE = 150.0
# Distance from the median of a normal distribution to its quartile, in standard deviations. It converts the measured
# distance in an image to the rms noise.
_QUARTILE = 0.6745
# Parameter Q of the asinh stretch of colour pictures by Lupton et al. 2004: a larger Q compresses bright pixels more.
_SOFTENING = 8.0
# Parameter `stretch` of the asinh stretch of colour pictures by Lupton et al. 2004, in rms noise of a sky pixel: a
# larger value makes faint pixels darker.
_STRETCH = 12.0
# Colours of the text and of the background of the figure.
_INK, _PAPER = "#e8e6df", "#0b0d12"
# Number of pictures (one per camera) side by side in the figure; more pictures continue in the next row.
_COLUMNS = 3
# Width and height in inches of a figure with two rows of pictures.
_INCHES = (13.2, 9.35)
# Pixels per inch of the figure.
_DPI = 100

# A science image: its columns in the tables `exposures` and `tasks` by name, and its path under the key "file".
Row = dict[str, Any]


def draw(root: Path, out: Path, request: str | None = None) -> list[Path]:
    """Draw the same patch of sky in all cameras of a request that observe it.

    The file `same_sky.png` has one picture per camera, `colour.png` one picture of three bands.

    Parameters
    ----------
    root : Path
        Lake (folder of stored tables and images).
    out : Path
        Folder of the PNG files, which is made if necessary.
    request : str, optional
        Name of the request; required if the lake has several.

    Returns
    -------
    list of Path
        The PNG files that were written. There is no `same_sky.png` if fewer than three cameras observe the patch, and
        no `colour.png` without a set of three bands. It is [] if the request has fewer than three cameras.
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
    """Resample a patch of sky, `SIDE` arcsec wide, from an image, with north up and east to the left.

    Parameters
    ----------
    file : Path
        Image file of a detector.
    place : tuple of float
        ICRS ra and dec of the centre of the patch in degrees.
    pixels : int
        Pixels along each side of the result.
    order : int
        Order of the spline interpolation, 0 to 5; 0 takes the nearest pixel.

    Returns
    -------
    float array, shape (pixels, pixels)
        Values in electrons per pixel of the image; NaN outside the image. The first row is the southernmost.
    """
    image = read_back.electrons(file)
    data = np.asarray(image.data, float)
    step = SIDE * ((np.arange(pixels) + 0.5) / pixels - 0.5)
    # Offsets in arcsec from the centre: `across` to the west, `up` to the north.
    across, up = np.meshgrid(step, step)
    ra, dec = pointing.sky_of_plane(across.ravel(), up.ravel(), *place, 0.0)
    column, row = astrometry.pixel_of_sky(astrometry.from_cards(image.cards), ra, dec)
    values = scipy.ndimage.map_coordinates(data, [row, column], order=order, mode="constant", cval=np.nan)
    return np.asarray(values.reshape(pixels, pixels))


def colours(red: Float, green: Float, blue: Float) -> Array:
    """Combine images in three bands into a colour picture with the stretch of Lupton et al. 2004.

    Parameters
    ----------
    red, green, blue : float array, shape (ny, nx)
        Signal above the sky, divided by the noise of each image; NaN counts as 0.

    Returns
    -------
    uint8 array, shape (ny, nx, 3)
        RGB values, 0 to 255.
    """
    from astropy.visualization import make_lupton_rgb

    layers = [np.nan_to_num(layer) for layer in (red, green, blue)]
    return np.asarray(make_lupton_rgb(*layers, minimum=-1.0, stretch=_STRETCH, Q=_SOFTENING))


def _rows(root: Path, request: str | None) -> list[Row]:
    """Return the science images of the sky that a request has, each with its file, its footprint and its exposure.

    A row is a dict of the columns of the tables `exposures` and `tasks`, and of the path of the image as "file".
    """
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
            image_rows.append({**exposure, **task, "file": read_back.image_file(version, row["path"])})
    return image_rows


def _wavelength_offset(row: Row) -> float:
    """Return how far the pivot wavelength of an image's band is from `_WAVELENGTH`, in angstrom."""
    return abs(passbands.pivot_wavelength(passbands.load(row["band"])) - _WAVELENGTH)


def _camera(row: Row) -> tuple[str, str]:
    return row["channel"], row["camera"]


def _best_place(rows: Sequence[Row], cameras: Sequence[tuple[str, str]]) -> tuple[float, float]:
    """Return the position (ra, dec in degrees) of the patch that the largest number of cameras observe completely.

    The trial positions lie on a grid over each image of the camera with the fewest images. If several positions are
    observed by equally many cameras, the one nearest to the centre of its image is returned.
    """
    rows_by_camera = {camera: [row for row in rows if _camera(row) == camera] for camera in cameras}
    fewest = rows_by_camera[min(cameras, key=lambda camera: (len(rows_by_camera[camera]), camera))]
    step = np.linspace(-1.0, 1.0, _GRID_SIZE) * 3600.0 * max(row["radius"] for row in fewest) / np.sqrt(2.0)
    across, up = (axis.ravel() for axis in np.meshgrid(step, step))
    candidates = [pointing.sky_of_plane(across, up, row["ra"], row["dec"], 0.0) for row in fewest]
    ra, dec = (np.concatenate([place[i] for place in candidates]) for i in (0, 1))
    corners = _corners(ra, dec)
    n_cameras = np.sum([_contains_patch(rows_by_camera[camera], corners) for camera in cameras], axis=0)
    # Distance of each trial position from the centre of its image (arcsec). It decides between positions that equally
    # many cameras observe.
    distance = np.tile(np.hypot(across, up), len(fewest))
    best = int(np.lexsort((distance, -n_cameras))[0])
    return float(ra[best]), float(dec[best])


def _corners(ra: Float, dec: Float) -> Float:
    """Return the corners (ra, dec in degrees), shape (n, 4, 2), of patches centred on n positions (in degrees)."""
    half = 0.5 * SIDE
    x, y = np.array([-half, half, -half, half]), np.array([-half, -half, half, half])
    return np.array([np.transpose(pointing.sky_of_plane(x, y, a, d, 0.0)) for a, d in zip(ra, dec, strict=True)])


def _contains_patch(rows: Sequence[Row], corners: Float) -> Int:
    """Return for n patches, given by their corners, 1 if a single image contains the patch completely, otherwise 0."""
    flat = corners.reshape(-1, 2)
    contained = np.zeros(len(corners), bool)
    for row in rows:
        contained |= (footprints.counts(_footprint(row), flat[:, 0], flat[:, 1]).reshape(-1, 4) > 0).all(axis=1)
    return contained.astype(np.int64)


def _rows_with_patch(place: tuple[float, float], rows: Sequence[Row]) -> list[Row]:
    """Return the images that contain the whole patch centred on a position (ra, dec in degrees)."""
    corners = _corners(np.array([place[0]]), np.array([place[1]]))
    return [row for row in rows if _contains_patch([row], corners)[0]]


def _footprint(row: Row) -> pa.Table:
    return pa.Table.from_pylist([{name: row[name] for name in ("ra", "dec", "radius", "s_region")}])


def _sky_and_noise(image: Float) -> tuple[float, float]:
    """Return the sky level (median) and the noise of an image, from the distance of its lower quartile to the median.

    NaN is ignored. Sources and cosmic rays hardly change the result, because they only make few pixels brighter.
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
    """Draw a colour picture of the patch from three bands (red, green, blue) and return its path.

    The picture of a band is the median of its exposures, which is free of cosmic rays if there are at least three.
    """
    from matplotlib.image import imsave

    layers = []
    for rows in bands.values():
        # Factors that convert electrons to flux density f_nu, with the same unit in all bands.
        scale = [10.0 ** (-0.4 * row["zero_point"]) / row["exposure_time_s"] for row in rows]
        patches = [patch(row["file"], place, _COLOUR_PIXELS, order=1) for row in rows]
        above = np.sort([s * (p - _sky_and_noise(p)[0]) for s, p in zip(scale, patches, strict=True)], axis=0)
        # Take the median of each pixel, or the lower of the two middle values for an even number of exposures.
        layers.append(above[(len(above) - 1) // 2])
    picture = colours(*(layer / _sky_and_noise(layer)[1] for layer in layers))
    path.parent.mkdir(parents=True, exist_ok=True)
    imsave(path, picture, origin="lower")
    return path
