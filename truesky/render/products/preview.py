"""Draw preview pictures (PNG) of rendered images: asinh stretch, labels of sources, scale bar, compass, close-ups.

Cosmic rays are removed from the pictures if the lake has truth maps of them (images of their true signal).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lake_schema.arrays import Array, Bool, Float
from lake_schema.fits import images
from lake_schema.fits.images import Card
from lake_schema.store import read
from truesky.numerics import activity, matrices
from truesky.render.camera import astrometry
from truesky.render.products import preview_labels, read_back
from truesky.render.products.preview_labels import CLOSE_UP_ARCSEC, CLOSE_UP_SHAPE, CLOSE_UPS, LABELS, Label
from truesky.render.products.sidecar_files import spectra_file

if TYPE_CHECKING:
    from astropy.wcs import WCS

# Height of a preview picture, largest width and height of its overview, width and height of a close-up, distance
# between close-ups, and width of the margins, inches. The picture is as wide as these require: CCDs of some cameras are
# twice as high as wide.
_HEIGHT, _OVERVIEW_INCHES, _CLOSE_UP_INCHES, _GAP, _MARGIN = 9.6, (9.44, 8.93), (3.366, 2.928), 0.077, 0.132
# Width in inches below which the caption of a picture does not fit next to its title and has two lines.
_ONE_LINE = 12.0
# Pixels per inch of a preview picture.
_DPI = 100
# Largest side in pixels of the overview, which shows the whole image. Close-ups have full resolution.
_OVERVIEW = 1000
# Space for the label of a source, as fractions of the height of the image. Labels whose spaces overlap that of a
# brighter source are not drawn.
_LABEL_SIZE = (0.14, 0.035)
# A pixel hit by a cosmic ray is replaced by the median of pixels up to this number of rows and columns away.
_MEND_RADIUS = 2
# Only every n-th row and column of the whole image is used to measure its sky level and noise for a close-up. For the
# overview they are measured in the reduced image.
_STRIDE = 8
# Signal above the sky, in rms noise of a sky pixel, at and below which a preview picture is black.
_BLACK = -1.5
# Signal above the sky, in rms noise of a sky pixel, up to which the brightness of a preview picture is about linear in
# the signal. Above it, the brightness is logarithmic.
_KNEE = 4.0
# Signal above the sky, in rms noise of a sky pixel, that a preview picture shows in white, as all brighter pixels.
_WHITE = 400.0
# Colours of lines and text, of the background, and of the labels of galaxies and stars.
_INK, _PAPER, _GALAXY, _STAR = "#e8e6df", "#0b0d12", "#ffd27d", "#9fd3ff"
# Possible lengths of a scale bar, arcsec.
_SCALE_BARS = (1, 2, 5, 10, 20, 30, 60, 120, 300, 600)


def rows_to_draw(root: Path, max_images: int | None = None, request: str | None = None) -> list[dict[str, Any]]:
    """Return the rows of table `products` of science images of a request of which previews are drawn.

    Parameters
    ----------
    root : Path
        Lake (folder of stored tables and images).
    max_images : int, optional
        Largest number of images, of as many channels and bands as possible; None means all images.
    request : str, optional
        Name of the request; required if the lake has several.

    Returns
    -------
    list of dict
        The rows; [] if the request has no science images. The value of `cosmic_rays` is the path of the image of the
        cosmic rays on the same detector, or None.
    """
    rows = read.version(root, "products", request=request).rows().to_pylist()
    hits = {_detector_key(row): row["path"] for row in rows if row["content"] == "cosmic_rays"}
    selected = select_images([row for row in rows if row["content"] == "science"], max_images)
    return [{**row, "cosmic_rays": hits.get(_detector_key(row))} for row in selected]


def draw(row: dict[str, Any], root: Path, out: Path, request: str | None = None) -> Path:
    """Draw a PNG file of one science image, and return its path.

    Parameters
    ----------
    row : dict
        Row of table `products`, from `rows_to_draw`.
    root : Path
        Lake (folder of stored tables and images).
    out : Path
        Folder of the PNG file, which is made if necessary.
    request : str, optional
        Name of the request; required if the lake has several.

    Returns
    -------
    Path
        The PNG file.
    """
    version = read.version(root, "products", request=request)
    with activity.report(f"picture of detector {row['detector']}, exposure {row['exposure_id']}"):
        image = read_back.electrons(read_back.image_file(version, row["path"]))
        if row["cosmic_rays"] is not None:
            (truth,) = images.read_images(version.sidecar_path(row["cosmic_rays"]))
            image = images.Image(repair_cosmic_rays(np.asarray(image.data), np.asarray(truth.data) > 0), image.cards)
        path = out / f"{row['channel']}_{row['band']}_{row['detector']}_{row['exposure_id']}.png".lower()
        spectra_path = spectra_file(row["exposure_id"], row["detector"])
        spectra = version.read_sidecar(spectra_path) if version.has_file(spectra_path) else None
        labels = preview_labels.labels(root, row, image, version.manifest["facts"]["inputs"], spectra)
        picture(path, np.asarray(image.data), image.cards, labels)
    return path


def select_images(rows: Sequence[dict[str, Any]], max_images: int | None) -> list[dict[str, Any]]:
    """Select at most `max_images` rows of the table `products` (None: all) and return them in their order.

    Each pair of channel and band is selected once before any is selected twice, and so on.
    """
    counts: Counter[tuple[str, str]] = Counter()
    order = []
    for i, row in enumerate(rows):
        kind = row["channel"], row["band"]
        order.append((counts[kind], i))
        counts[kind] += 1
    return [rows[i] for i in sorted(i for _, i in sorted(order)[:max_images])]


def _detector_key(row: dict[str, Any]) -> tuple[Any, ...]:
    return row["exposure_id"], row["detector"]


def repair_cosmic_rays(image: Float, hit_pixels: Bool) -> Float:
    """Replace pixels hit by cosmic rays with the median of the pixels around them that were not hit.

    `image` and `hit_pixels` have the shape (ny, nx). A pixel whose 24 neighbours were all hit keeps its value.
    """
    rows, columns = np.nonzero(hit_pixels)
    masked = np.where(hit_pixels, np.nan, image)
    step = np.arange(-_MEND_RADIUS, _MEND_RADIUS + 1)
    r = np.clip(rows[:, None, None] + step[:, None], 0, image.shape[0] - 1)
    c = np.clip(columns[:, None, None] + step, 0, image.shape[1] - 1)
    neighbours = np.sort(masked[r, c].reshape(len(rows), step.size**2), axis=1)
    # Count the neighbours that were not hit: pixels hit by cosmic rays are NaN, which sorting has moved to the end.
    count = np.isfinite(neighbours).sum(axis=1)
    median = neighbours[np.arange(len(rows)), np.maximum(count - 1, 0) // 2]
    out = image.copy()
    out[rows, columns] = np.where(count > 0, median, image[rows, columns])
    return out


def picture(path: Path, image: Array, cards: Sequence[Card], names: Sequence[Label]) -> None:
    """Draw the preview picture of one image: an overview with labels, and close-ups of galaxies.

    Parameters
    ----------
    path : Path
        PNG file to write; its folder is made if necessary.
    image : array, shape (ny, nx)
        Pixels in electrons or ADU.
    cards : sequence of Card
        FITS header of the image, with its WCS.
    names : sequence of Label
        Bright sources in the image, brightest first. Only those whose labels do not overlap are labelled.
    """
    # Use the Agg canvas directly: pyplot may need a window system, and shares its state with figures of the caller.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    header: dict[str, Any] = {keyword: value for keyword, value, _ in cards}
    system = astrometry.from_cards(cards)
    width = min(_OVERVIEW_INCHES[0], _OVERVIEW_INCHES[1] * image.shape[1] / image.shape[0])
    panels = width + 2 * _MARGIN
    total = panels + _CLOSE_UP_INCHES[0] + _MARGIN
    figure = Figure(figsize=(total, _HEIGHT), dpi=_DPI, facecolor=_PAPER)
    FigureCanvasAgg(figure)
    upside_down = astrometry.jacobian(system, [0.0], [0.0])[0, 1, 1] < 0
    main = figure.add_axes((_MARGIN / total, _MARGIN / _HEIGHT, width / total, _OVERVIEW_INCHES[1] / _HEIGHT))
    block = max(1, int(np.ceil(max(image.shape) / _OVERVIEW)))
    _show_image(main, _shrink(image, block), block, image.shape, upside_down)
    text_x, text_y = (size * image.shape[0] for size in _LABEL_SIZE)
    _annotate(main, preview_labels.without_overlaps(names, text_x, text_y, LABELS), image.shape, upside_down)
    _scale_bar(main, header["PIXSCALE"], image.shape, image.shape[1] / 6)
    _compass(main, system, image.shape)
    for number, label in enumerate(preview_labels.close_ups(names, image.shape, header["PIXSCALE"])):
        bottom = _MARGIN + (_CLOSE_UP_INCHES[1] + _GAP) * (CLOSE_UPS - 1 - number)
        axes = figure.add_axes(
            (panels / total, bottom / _HEIGHT, _CLOSE_UP_INCHES[0] / total, _CLOSE_UP_INCHES[1] / _HEIGHT)
        )
        _close_up(axes, main, image, label, header["PIXSCALE"], upside_down, "abc"[number])
    # Lakes of the first versions have no card BAND; their card FILTER has the same value.
    band = header.get("BAND", header["FILTER"])
    title = f"{header['INSTRUME'].upper()} {header['DETECTOR']}   {band}   {header['EXPTIME']:g} s"
    caption = ("\n" if total < _ONE_LINE else "   ").join(_caption(header, system, image.shape))
    figure.text(0.012, 0.958, title, color=_INK, fontsize=15, fontweight="bold")
    figure.text(0.988, 0.958, caption, color=_INK, fontsize=10.5, ha="right", linespacing=1.4)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, facecolor=_PAPER, metadata={"Software": None})


def _caption(header: dict[str, Any], system: WCS, shape: tuple[int, ...]) -> tuple[str, str]:
    """Return two texts: position and size of an image of `shape` pixels, and its PSF, sources and version."""
    ra, dec = astrometry.sky_of_pixel(system, [(shape[1] - 1) / 2], [(shape[0] - 1) / 2])
    size = [n * header["PIXSCALE"] / 60.0 for n in shape[::-1]]
    return (
        f"RA {ra[0]:.4f}  Dec {dec[0]:+.4f}   {size[0]:.1f}' x {size[1]:.1f}'",
        f'PSF {header["PSFFWHM"]:.2f}"   {header["NSOURCES"]:,} sources   truesky {header["TRUESKY"]}',
    )


def _shrink(image: Array, block: int) -> Float:
    ny, nx = (n // block for n in image.shape)
    return np.asarray(image[: ny * block, : nx * block].reshape(ny, block, nx, block).mean((1, 3), dtype=float))


def _show_image(axes: Any, image: Float, block: int, shape: tuple[int, ...], upside_down: bool) -> None:
    ny, nx = (n * block for n in image.shape)
    extent = (-0.5, nx - 0.5, -0.5, ny - 0.5)
    stretched = _stretch(image, *_sky_and_noise(image))
    axes.imshow(stretched, origin="lower", extent=extent, cmap="gray", vmin=0, vmax=1, interpolation="none")
    _frame(axes, (-0.5, shape[1] - 0.5), (-0.5, shape[0] - 0.5), upside_down)


def _frame(axes: Any, x: tuple[float, float], y: tuple[float, float], upside_down: bool) -> None:
    """Set the limits of the axes to pixels `x` and `y`, and remove ticks.

    If `upside_down` is set, the image is rotated by 180 deg. This brings north up for detectors that are mounted upside
    down.
    """
    axes.set_xlim(x[::-1] if upside_down else x)
    axes.set_ylim(y[::-1] if upside_down else y)
    axes.set_anchor("W")
    axes.set_facecolor(_PAPER)
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set_edgecolor("#3a4150")


def _sky_and_noise(image: Array) -> tuple[float, float]:
    """Return the sky level (median) and the noise (rms of the pixels below the median) of an image.

    The noise is 1.0 if no pixel is below the median.
    """
    level = float(np.median(image))
    below = image[image < level] - level
    return level, float(np.sqrt(np.mean(below**2))) if below.size else 1.0


def _stretch(image: Array, level: float, noise: float) -> Float:
    """Scale pixels to brightness 0 (black) to 1 (white) with an asinh stretch of the signal above the sky `level`.

    `noise` is the noise of the sky; all three have the same unit.
    """
    signal = np.clip((image - level) / noise, _BLACK, _WHITE)
    lo, hi = np.arcsinh(_BLACK / _KNEE), np.arcsinh(_WHITE / _KNEE)
    return np.asarray((np.arcsinh(signal / _KNEE) - lo) / (hi - lo))


def _annotate(axes: Any, names: Sequence[Label], shape: tuple[int, ...], upside_down: bool) -> None:
    from matplotlib.patches import Circle, Rectangle

    for label in names:
        across, up = label.column / shape[1], label.row / shape[0]
        if upside_down:
            across, up = 1 - across, 1 - up
        if up < 0.12 and not 0.25 < across < 0.85:
            # Draw no label in the lower corners, which have the scale bar and the compass.
            continue
        colour = _GALAXY if label.kind == "galaxy" else _STAR
        style: dict[str, Any] = {"fill": False, "edgecolor": colour, "linewidth": 0.9, "alpha": 0.9}
        if label.box is None:
            axes.add_patch(Circle((label.column, label.row), shape[1] / 110, **style))
        else:
            x0, x1, y0, y1 = label.box
            axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, **style))
        text = axes.annotate(
            f"{label.kind} {label.text}",
            (label.column, label.row),
            (-9 if across > 0.85 else 9, 5 if up < 0.96 else -12),
            textcoords="offset points",
            ha="right" if across > 0.85 else "left",
            color=colour,
            fontsize=8.5,
        )
        text.set_path_effects(_outline())


def _outline() -> list[Any]:
    """Return a matplotlib effect that draws a dark outline around text, which makes it legible on a bright star."""
    from matplotlib import patheffects

    return [patheffects.withStroke(linewidth=2.0, foreground=_PAPER)]


def _scale_bar(axes: Any, pixel_scale: float, shape: tuple[int, ...], longest: float) -> None:
    """Draw a scale bar in the lower left corner of an image, with its length in arcsec or arcmin.

    The bar is the longest of `_SCALE_BARS` that is at most `longest` pixels long. `pixel_scale` is in arcsec.
    """
    arcsec = max((bar for bar in _SCALE_BARS if bar <= longest * pixel_scale), default=_SCALE_BARS[0])
    width = arcsec / pixel_scale / shape[1]
    axes.plot([0.03, 0.03 + width], [0.035, 0.035], color=_INK, linewidth=2.2, transform=axes.transAxes)
    text = f'{arcsec:g}"' if arcsec < 60 else f"{arcsec / 60:g}'"
    label = axes.text(0.03 + width / 2, 0.045, text, color=_INK, fontsize=11, ha="center", transform=axes.transAxes)
    label.set_path_effects(_outline())


def _compass(axes: Any, system: WCS, shape: tuple[int, ...]) -> None:
    """Draw arrows to the north and east in the lower right corner of an image, with the directions at its centre.

    `shape` is the number of rows and columns. The limits of the axes must be set before, since they may be reversed.
    """
    x, y = (shape[1] - 1) / 2, (shape[0] - 1) / 2
    inverse = matrices.inverse(astrometry.jacobian(system, [x], [y])[0])
    flip = np.array([1 if lim[0] < lim[1] else -1 for lim in (axes.get_xlim(), axes.get_ylim())])
    origin = np.array([1.0 - 0.07 * shape[0] / shape[1], 0.05])
    # Letters of the arrows, and their directions on the sky as (west, north).
    for name, world in (("N", (0.0, 1.0)), ("E", (-1.0, 0.0))):
        step = matrices.matmul(inverse, np.array(world)) * flip
        # In a narrow image, a fraction of the width is shorter than the same fraction of the height.
        step = step / np.hypot(*step) * 0.055 * np.array([shape[0] / shape[1], 1.0])
        axes.annotate(
            "",
            origin + step,
            origin,
            xycoords="axes fraction",
            arrowprops={"arrowstyle": "-|>", "color": _INK, "linewidth": 1.4, "shrinkA": 0, "shrinkB": 0},
        )
        axes.text(
            *(origin + 1.3 * step),
            name,
            color=_INK,
            fontsize=11,
            ha="center",
            va="center",
            transform=axes.transAxes,
        )


def _close_up(
    axes: Any,
    main: Any,
    image: Array,
    label: Label,
    pixel_scale: float,
    upside_down: bool,
    letter: str,
) -> None:
    from matplotlib.patches import Rectangle

    half_y = CLOSE_UP_ARCSEC / pixel_scale / 2
    half_x = half_y * CLOSE_UP_SHAPE
    square = (label.column - half_x, label.column + half_x, label.row - half_y, label.row + half_y)
    first_x, last_x, first_y, last_y = label.box or square
    x0, x1 = max(round(first_x), 0), min(round(last_x), image.shape[1])
    y0, y1 = max(round(first_y), 0), min(round(last_y), image.shape[0])
    stretched = _stretch(image[y0:y1, x0:x1], *_sky_and_noise(image[::_STRIDE, ::_STRIDE]))
    extent = (x0 - 0.5, x1 - 0.5, y0 - 0.5, y1 - 0.5)
    axes.imshow(stretched, origin="lower", extent=extent, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    if label.box is not None:
        # A trace is much longer than wide: stretch it to fill the panel.
        axes.set_aspect("auto")
    _frame(axes, extent[:2], extent[2:], upside_down)
    text = f"{letter}   {label.kind} {label.text}"
    axes.text(0.04, 0.92, text, color=_GALAXY, fontsize=10, transform=axes.transAxes).set_path_effects(_outline())
    _scale_bar(axes, pixel_scale, (y1 - y0, x1 - x0), (x1 - x0) / 4)
    main.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor=_INK, linewidth=0.8, alpha=0.8))
    corner = (x0, y1) if upside_down else (x1, y0)
    mark = main.annotate(letter, corner, (2, -2), textcoords="offset points", color=_INK, fontsize=10, va="top")
    mark.set_path_effects(_outline())
