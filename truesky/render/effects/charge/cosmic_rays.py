"""Cosmic rays: straight tracks one pixel wide that deposit charge along their length.

Cosmic rays during the integration hit the pixels that collect light. Cosmic rays during the readout hit a detector
whose rows are being shifted. They are placed in readout coordinates (row 0 is read first), in which later rows are
exposed for longer. Their charge passes only the traps between the point of impact and the register, after all other
charge has passed them, and has a separate trail.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.camera import amplifiers
from truesky.render.effects.effect import Effect, zero_contribution
from truesky.render.effects.scene import Frame, Scene

_SQUARE_CM = 1e-8
# Mission table with quantiles of a track's length (pixels) and charge (electrons).
_TRACKS = "env.cosmic_rays.vis_tracks"
# Length of a perpendicular track in pixels. It must not be 0, because lengths are interpolated in their logarithm.
_SHORTEST = 1e-2
# Expected number of tracks below which the effect is treated as absent.
_NEGLIGIBLE = 1e-3


def apply(frame: Frame, expected: float, quantiles: Frame, rng: np.random.Generator) -> Frame:
    """Add the charge of cosmic rays.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons.
    expected : float
        Mean number of tracks, 0 to 1e8.
    quantiles : float array, shape (q, 3)
        Same as in `draw_tracks`.
    rng : numpy.random.Generator
        Random numbers of the tracks.

    Returns
    -------
    float array, shape (ny, nx)
        Electrons including cosmic rays.
    """
    out = np.array(frame, dtype=float, order="C")
    _add_tracks(out, expected, quantiles, rng)
    return out


def draw_tracks(shape: tuple[int, ...], expected: float, quantiles: Frame, rng: np.random.Generator) -> Frame:
    """Draw an image of cosmic rays alone.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    expected : float
        Mean number of tracks, 0 to 1e8. The number drawn is Poisson.
    quantiles : float array, shape (q, 3)
        Cumulative probability, length in pixels and charge in electrons. Between rows, the logarithms of length and
        charge are interpolated linearly.
    rng : numpy.random.Generator
        Random numbers of the tracks.

    Returns
    -------
    float array, shape (ny, nx)
        Whole electrons.

    Raises
    ------
    OutOfRange
        If `expected` is outside its limits.

    Notes
    -----
    A track that leaves the image at one edge enters at the opposite edge. This replaces tracks that start outside the
    detector, so that the density of tracks is uniform.
    """
    out = np.zeros(shape)
    _add_tracks(out, expected, quantiles, rng)
    return out


def _add_tracks(out: Frame, expected: float, quantiles: Frame, rng: np.random.Generator) -> None:
    count = draw_event_count(expected, rng)
    if out.size:
        ny, nx = out.shape
        _, column, row, charge = pixels_of_events(draw_events(count, ny, nx, quantiles, rng))
        add_charge(out, row, column, charge)


@jit
def add_charge(frame: Any, row: Any, column: Any, charge: Any) -> None:
    """Add charge to pixels of a frame in place. Coordinates wrap around at the edges.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons.
    row, column : int array, shape (n,)
        Pixel positions, also outside the frame.
    charge : float array, shape (n,)
        Electrons to add to each pixel.
    """
    ny, nx = frame.shape
    for i in range(len(charge)):
        frame[row[i] % ny, column[i] % nx] += charge[i]


def draw_event_count(expected: float, rng: np.random.Generator) -> int:
    """Draw the Poisson number of cosmic rays for a mean of 0 to 1e8."""
    if not 0.0 <= expected <= 1e8:
        raise OutOfRange("cosmic rays", expected, 0.0, 1e8)
    return int(rng.poisson(expected))


def draw_events(count: int, ny: int, nx: int, quantiles: Frame, rng: np.random.Generator) -> tuple[Any, ...]:
    """Draw start, direction, length and charge of tracks.

    Parameters
    ----------
    count : int
        Number of tracks.
    ny, nx : int
        Rows and columns in which they start.
    quantiles : float array, shape (q, 3)
        Same as in `draw_tracks`.
    rng : numpy.random.Generator
        Random numbers of the tracks.

    Returns
    -------
    x, y : float array, shape (count,)
        Start in pixels.
    cosine, sine : float array, shape (count,)
        Direction.
    length : float array, shape (count,)
        Projected length in pixels.
    electrons : float array, shape (count,)
        Charge, whole electrons.

    Notes
    -----
    Length and charge have the same rank, as in Niemi 2015: a longer path through the silicon leaves more charge.
    """
    chance, length, charge = quantiles.T
    angle = 2.0 * np.pi * rng.random(count)
    x, y, rank = nx * rng.random(count), ny * rng.random(count), rng.random(count)
    electrons = np.rint(np.exp(np.interp(rank, chance, np.log(charge))))
    return x, y, np.cos(angle), np.sin(angle), np.exp(np.interp(rank, chance, np.log(length))), electrons


@jit
def pixels_of_events(events: tuple[Any, ...]) -> Any:
    """Trace tracks through the pixel grid.

    Parameters
    ----------
    events : tuple of float arrays, shape (count,)
        Result of `draw_events`.

    Returns
    -------
    event : int array, shape (n,)
        Index of the track, for every pixel that a track crosses.
    column, row : int array, shape (n,)
        Position of the pixel on an unbounded grid.
    charge : float array, shape (n,)
        Charge left in the pixel, whole electrons.
    """
    x, y, cosine, sine, length, electrons = events
    size = 0
    for i in range(len(x)):
        # Upper limit: at each step a track enters the next column or the next row.
        size += int(length[i] * (abs(cosine[i]) + abs(sine[i]))) + 4
    event, columns, rows = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.int64)
    charge, n = np.empty(size), 0
    for i in range(len(x)):
        column, row = int(np.floor(x[i])), int(np.floor(y[i]))
        step_x, step_y = (1 if cosine[i] > 0 else -1), (1 if sine[i] > 0 else -1)
        per_x, per_y = 1.0 / max(abs(cosine[i]), 1e-12), 1.0 / max(abs(sine[i]), 1e-12)
        next_x = ((column + 1 - x[i]) if step_x > 0 else (x[i] - column)) * per_x
        next_y = ((row + 1 - y[i]) if step_y > 0 else (y[i] - row)) * per_y
        previous = 0.0
        while True:
            along = min(min(next_x, next_y), length[i])
            # Differences of the rounded cumulative charge are whole electrons and add up to the track's total.
            cumulative = np.rint(electrons[i] * along / length[i])
            event[n], columns[n], rows[n], charge[n] = i, column, row, cumulative - previous
            n += 1
            previous = cumulative
            if along >= length[i]:
                break
            if next_x < next_y:
                next_x += per_x
                column += step_x
            else:
                next_y += per_y
                row += step_y
    return event[:n], columns[:n], rows[:n], charge[:n]


def event_rate(scene: Scene, pixels: float) -> float:
    """Cosmic rays per second on an area of the detector.

    Parameters
    ----------
    scene : Scene
        The exposure. A ground camera has the rate of its site; for space the flux is part of the environment.
    pixels : float
        Size of the area in pixels.

    Returns
    -------
    float
        Tracks per second.
    """
    if f"{scene.section}.cosmic_rays.rate" in scene.mission and scene.detector is not None:
        nx, ny = amplifiers.full_size(scene.detector, scene.mission)
        return scene.value("cosmic_rays.rate", "1 / s") * pixels / (nx * ny)
    area = pixels * scene.value("fpa.pixel_size", "um / pix") ** 2 * _SQUARE_CM
    return scene.mission.value("env.cosmic_rays.flux_stardust", "cm-2 s-1") * area


def track_quantiles(scene: Scene) -> Frame:
    """Return the quantiles for `draw_tracks`: muons for a ground camera, else the table in the mission database."""
    if f"{scene.section}.cosmic_rays.rate" in scene.mission:
        deposit = scene.mission.value("env.cosmic_rays.silicon_deposit", "electron / um")
        return muon_quantiles(
            scene.value("cosmic_rays.thickness", "um"), scene.value("fpa.pixel_size", "um / pix"), deposit
        )
    return np.array(scene.mission.numbers(_TRACKS))


def muon_quantiles(thickness: float, pixel: float, deposit: float) -> Frame:
    """Quantiles of muon tracks through a horizontal detector.

    Parameters
    ----------
    thickness, pixel : float
        Thickness of the silicon and size of a pixel in micrometres.
    deposit : float
        Charge per path length in electrons per micrometre.

    Returns
    -------
    float array, shape (55, 3)
        Same as `quantiles` in `draw_tracks`.

    Notes
    -----
    The intensity is proportional to cos^2 of the zenith angle, and the flux through the detector to cos^3. Not
    modelled: fluctuations of the energy loss, electrons from radioactivity, and the tilt of the detector.
    """
    cumulative = np.append(np.linspace(0.0, 0.98, 50), [0.99, 0.999, 0.9999, 1.0 - 1e-6])
    cosine = (1.0 - cumulative) ** 0.25
    length = np.maximum(thickness * np.sqrt(1.0 - cosine**2) / (cosine * pixel), _SHORTEST)
    table = np.stack([cumulative, length, deposit * thickness / cosine], axis=1)
    return np.concatenate([table, [[1.0, 1.001 * table[-1, 1], 1.001 * table[-1, 2]]]])


def _expected_events(scene: Scene) -> float:
    return event_rate(scene, float(scene.nx * scene.ny)) * scene.exposure_time_s


def brightest_pixel(scene: Scene) -> float:
    """Return the highest charge in electrons that a track is likely to leave in one pixel.

    This is all of its charge if the track is shorter than a pixel, else the charge per pixel of length.
    """
    _, length, charge = track_quantiles(scene).T
    return float((charge / np.maximum(length, 1.0)).max())


def median_pixel(scene: Scene, expected: float) -> float:
    """Return the charge per pixel of the median track in electrons, 0 if `expected` tracks are negligible."""
    _, length, charge = track_quantiles(scene).T
    middle = len(length) // 2
    return float(charge[middle] / length[middle]) * (expected > _NEGLIGIBLE)


EFFECT = Effect(
    "cosmic_rays",
    apply,
    lambda scene: (_expected_events(scene), track_quantiles(scene)),
    lambda scene: median_pixel(scene, _expected_events(scene)),
    cost=4e-3,
    systematic=zero_contribution,
)
