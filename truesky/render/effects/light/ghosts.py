"""Ghosts: light that is reflected twice in a plate forms a defocused image of the pupil near each bright star.

A ghost is an annulus of uniform surface brightness, with gaps for the three arms that hold the secondary mirror of the
telescope. The plate is the dichroic in the effect `EFFECT`, and the filter in the effect `FILTER`.

Light of order n was reflected n times by the back of the plate. It travels n times as far through the plate: its ghost
is n times as wide, and about n times as far from the star. The offset is a polynomial of the star's position in the
focal plane (`lake_schema.mission.ghost_offsets`).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange
from lake_schema.mission import ghost_offsets
from truesky.numerics.compiling import jit
from truesky.render.camera.detectors import Detector
from truesky.render.effects.effect import Effect, copy_frame
from truesky.render.effects.scene import Frame, Lights, Scene

# Number of samples along each side of a pixel, to compute the part of the pixel that a ghost covers.
_SUBSAMPLES = 4
# Half of the diagonal of a pixel in pixels, with a margin for rounding.
_HALF_DIAGONAL = 0.72
# Stands for the detector of a scene without one, which has the axes of the focal plane.
_WITHOUT_DETECTOR = Detector("", "", 0, 0, 0.0, 0.0, 0.0, 1.0)


class Pupil(NamedTuple):
    """Shape of a ghost: the defocused image of the telescope's pupil, an annulus with gaps, in pixels.

    Attributes
    ----------
    radius : float
        Outer radius, 0.5 to 1e4.
    hole : float
        Inner radius relative to the outer radius, 0 to 0.99.
    arms : tuple of (float, float, float, float)
        For each arm that holds the secondary mirror: column and row of its middle relative to the centre of the ghost
        (pixels), angle from the x axis towards the y axis (degrees), and half of its length (pixels).
    width : float
        Width of each arm, 0 to `radius`.
    """

    radius: float
    hole: float
    arms: tuple[tuple[float, float, float, float], ...]
    width: float


class Order(NamedTuple):
    """Ghosts of one order.

    Attributes
    ----------
    lights : Lights
        Positions (columns and rows) and electrons of the stars.
    ratio : float
        Flux of a ghost relative to its star, 0 to 1.
    offset : (float array, float array), shape (n,)
        Positions of the centres of the ghosts minus the positions of their stars, in columns and rows.
    pupil : Pupil
        Shape of a ghost.
    """

    lights: Lights
    ratio: float
    offset: tuple[Float, Float]
    pupil: Pupil


def apply(
    frame: Frame, orders: Sequence[Order], rng: np.random.Generator | None = None, out: Frame | None = None
) -> Frame:
    """Add the ghosts of stars to a frame, also of stars outside the frame.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons.
    orders : sequence of Order
        The ghosts of each order.
    rng : numpy.random.Generator, optional
        Not used.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons including ghosts.

    Raises
    ------
    OutOfRange
        If the ratio or a value of the pupil of an order is outside its limits. The values of the arms are not checked.
    """
    out = copy_frame(frame, out)
    for order in orders:
        _add_order(out, order)
    return out


def _add_order(frame: Frame, order: Order) -> None:
    lights, ratio, offset, (radius, hole, arms, width) = order
    for name, value, lowest, highest in (
        ("ghost ratio", ratio, 0.0, 1.0), ("ghost radius", radius, 0.5, 1e4), ("ghost hole", hole, 0.0, 0.99),
        ("ghost arms", width, 0.0, radius),
    ):  # fmt: skip
        if not lowest <= value <= highest:
            raise OutOfRange(name, value, lowest, highest)
    if ratio == 0.0 or frame.size == 0 or not len(lights.electrons):
        return
    stamp = _pupil_image(radius, hole, np.array(arms, float).reshape(-1, 4), width)
    stamp /= stamp.sum()
    _add_stamps(frame, lights.column + offset[0], lights.row + offset[1], ratio * lights.electrons, stamp)


@jit
def _pupil_image(radius: float, hole: float, arms: Any, width: float) -> Any:
    """Return the fraction of each pixel that the pupil image of a ghost covers, a square array with an odd side.

    The centre of the pupil is in the middle of the middle pixel. `radius` is the outer radius of the annulus in pixels,
    and `hole` the inner radius relative to it. `arms` [n, 4] are the shadows of the arms: column and row of the middle
    relative to the centre (pixels), angle (degrees) and half of the length (pixels). `width` is their width in pixels.
    """
    half = int(np.ceil(radius)) + 1
    stamp = np.zeros((2 * half + 1, 2 * half + 1))
    for r in range(2 * half + 1):
        for c in range(2 * half + 1):
            # Most pixels are far from all borders and need no samples.
            middle = np.hypot(c - half, r - half)
            if middle > radius + _HALF_DIAGONAL or middle < hole * radius - _HALF_DIAGONAL:
                continue
            is_inside = hole * radius + _HALF_DIAGONAL < middle < radius - _HALF_DIAGONAL
            for arm in arms:
                dx, dy, angle = c - half - arm[0], r - half - arm[1], np.radians(arm[2])
                across = abs(dy * np.cos(angle) - dx * np.sin(angle))
                is_inside = is_inside and (
                    np.hypot(dx, dy) > arm[3] + _HALF_DIAGONAL or across > 0.5 * width + _HALF_DIAGONAL
                )
            if is_inside:
                stamp[r, c] = 1.0
                continue
            lit = 0
            for i in range(_SUBSAMPLES):
                for j in range(_SUBSAMPLES):
                    x, y = c - half + (j + 0.5) / _SUBSAMPLES - 0.5, r - half + (i + 0.5) / _SUBSAMPLES - 0.5
                    distance = np.hypot(x, y)
                    inside = hole * radius <= distance <= radius
                    for arm in arms:
                        dx, dy, angle = x - arm[0], y - arm[1], np.radians(arm[2])
                        across = dy * np.cos(angle) - dx * np.sin(angle)
                        inside = inside and not (np.hypot(dx, dy) <= arm[3] and abs(across) < 0.5 * width)
                    lit += inside
            stamp[r, c] = lit / (_SUBSAMPLES * _SUBSAMPLES)
    return stamp


@jit
def _add_stamps(frame: Any, column: Any, row: Any, electrons: Any, stamp: Any) -> None:
    """Add a ghost at each position to a frame, in place. Fractional positions are interpolated bilinearly.

    `column` and `row` are the centres of the ghosts in pixels, and `electrons` their total fluxes. The image of a ghost
    is `stamp`, a square array with an odd side and a sum of 1.
    """
    ny, nx = frame.shape
    half = len(stamp) // 2
    for i in range(len(column)):
        if not (-half - 2.0 < column[i] < nx + half + 2.0 and -half - 2.0 < row[i] < ny + half + 2.0):
            continue
        x0, y0 = int(np.floor(column[i])), int(np.floor(row[i]))
        fx, fy = column[i] - x0, row[i] - y0
        for r in range(max(0, y0 - half), min(ny, y0 + half + 2)):
            for c in range(max(0, x0 - half), min(nx, x0 + half + 2)):
                light = 0.0
                for dr in range(2):
                    for dc in range(2):
                        sr, sc = r - y0 + half - dr, c - x0 + half - dc
                        if 0 <= sr < len(stamp) and 0 <= sc < len(stamp):
                            light += (fy if dr else 1.0 - fy) * (fx if dc else 1.0 - fx) * stamp[sr, sc]
                frame[r, c] += electrons[i] * light


def parameters(scene: Scene, plate: str = "ghost") -> tuple[tuple[Order, ...]]:
    """Return the parameters of `apply` for the ghosts of a plate: stars, flux ratio, offset and shape by order.

    `plate` is the prefix of the parameters in the mission database: "ghost" for the dichroic, "filter_ghost" for the
    filter. Stars (`Lights`) whose ghosts are not noticeable are left out. The shape (`Pupil`) has gaps where the arms
    in the telescope's pupil block the light.
    """
    orders = ghost_offsets.orders(scene.mission, scene.section, plate)
    return (tuple(_ghosts_of_order(scene, plate, order) for order in orders),)


def _ghosts_of_order(scene: Scene, plate: str, order: int) -> Order:
    detector = scene.detector or _WITHOUT_DETECTOR
    ratio, radius = flux_ratio(scene, plate, order), order * scene.value(f"{plate}.radius_out", "pix")
    lights = noticeable_lights(scene, ratio, radius)
    scale = radius / (0.5 * scene.mission.value("plm.aperture_diameter", "mm"))

    def pupil_value(key: str, unit: str) -> float:
        return scene.mission.value(f"plm.pupil.{key}", unit)

    reach = scale * pupil_value("spider_half_length", "mm")
    places = [[scale * pupil_value(f"spider{number}.{axis}", "mm") for axis in "xy"] for number in (1, 2, 3)]
    # Convert the arms from the axes of the focal plane to the axes of the detector.
    arms = tuple(
        (float(x), float(y), detector.own_degrees(pupil_value(f"spider{number}.angle", "deg")), reach)
        for number, (x, y) in enumerate((detector.from_focal_plane(*place) for place in places), start=1)
    )
    hole, width = scene.value(f"{plate}.radius_in_ratio", ""), scale * pupil_value("spider_width", "mm")
    return Order(lights, ratio, offset(scene, plate, order, lights), Pupil(radius, hole, arms, width))


def flux_ratio(scene: Scene, plate: str, order: int) -> float:
    """Return the flux of a ghost relative to its star.

    Parameters
    ----------
    scene : Scene
        Settings of the exposure.
    plate : str
        Prefix of the parameters in the mission database: "ghost" for the dichroic, "filter_ghost" for the filter.
    order : int
        Order of the ghost, from 1.

    Returns
    -------
    float
        Flux of the ghost divided by the flux of the star.
    """
    ratio = scene.value(f"{plate}.flux_ratio", "")
    return ratio if order == 1 else ratio * scene.value(f"{plate}.order_ratio", "") ** (order - 1)


def offset(scene: Scene, plate: str, order: int, lights: Lights) -> tuple[Float, Float]:
    """Return the offsets from stars to their ghosts in columns and rows.

    Parameters
    ----------
    scene : Scene
        Settings of the exposure. Without a detector, columns and rows are the axes of the focal plane, and the stars
        are taken to be in its middle.
    plate : str
        Prefix of the parameters in the mission database: "ghost" for the dichroic, "filter_ghost" for the filter.
    order : int
        Order of the ghosts.
    lights : Lights
        Positions of the stars.

    Returns
    -------
    columns, rows : float array, shape (n,)
        Offsets in pixels.
    """
    detector = scene.detector or _WITHOUT_DETECTOR
    first_column, first_row = (scene.window.column, scene.window.row) if scene.window is not None else (0, 0)
    x, y = detector.focal_plane_place(lights.column + first_column, lights.row + first_row)
    if scene.detector is None:
        x, y = np.zeros((2, len(lights.electrons)))
    moved = ghost_offsets.offset(scene.mission, (scene.section, plate), order, x / 3600.0, y / 3600.0)
    return detector.from_focal_plane(*moved)


def noticeable_lights(scene: Scene, ratio: float, radius: float) -> Lights:
    """Return the stars whose ghost, summed over its area, is noticeable compared with the noise of the same area.

    Parameters
    ----------
    scene : Scene
        Settings of the exposure, with the bright stars and the noise of a pixel.
    ratio : float
        Flux of a ghost relative to its star.
    radius : float
        Radius of a ghost, pixels.

    Returns
    -------
    Lights
        Selected stars, in their original order.
    """
    area = np.pi * radius**2
    lights = scene.lights
    bright = ratio * lights.electrons > scene.noticeable_electrons * np.sqrt(area)
    return Lights(lights.column[bright], lights.row[bright], lights.electrons[bright])


def _contribution(scene: Scene, plate: str = "ghost") -> float:
    """Return the strength of the brightest star's ghost: electrons per pixel times the root of its number of pixels.

    The square root is included because the eye, or a fit, detects a ghost in all of its pixels together.
    """
    ratio, radius = scene.value(f"{plate}.flux_ratio", ""), scene.value(f"{plate}.radius_out", "pix")
    brightest = float(scene.lights.electrons.max(initial=0.0))
    return ratio * brightest / float(np.sqrt(np.pi) * radius)


def _mean_contribution(scene: Scene, plate: str = "ghost") -> float:
    """Return the electrons per pixel of the brightest star's ghost.

    `Effect.margin` compares this number with the noise of a mean over many pixels. The result of `_contribution` cannot
    be used for this comparison, because it already takes the mean over the pixels of the ghost into account.
    """
    return _contribution(scene, plate) / float(np.sqrt(np.pi) * scene.value(f"{plate}.radius_out", "pix"))


EFFECT = Effect("ghosts", apply, parameters, _contribution, cost=4.5e-3, systematic=_mean_contribution, in_place=True)
FILTER = Effect(
    "filter_ghosts",
    apply,
    partial(parameters, plate="filter_ghost"),
    partial(_contribution, plate="filter_ghost"),
    cost=4.5e-3,
    systematic=partial(_mean_contribution, plate="filter_ghost"),
    in_place=True,
)
