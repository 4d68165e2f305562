"""Cosmic rays: straight tracks that deposit charge along their length, by default one pixel wide.

Cosmic rays during the exposure hit the pixels that collect light. Functions of this module also draw the tracks for
the module `readout_cosmic_rays`: cosmic rays during the readout, which hit a detector whose rows are being shifted
towards the serial register. That module counts rows from the register (row 0 is read first), and later rows wait for
longer. The charge of these tracks passes only the traps between the point of impact and the register. As an
approximation, it is added after the trails of all other charge are computed, and gets a separate trail.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.camera import amplifiers
from truesky.render.effects.charge import track_charge
from truesky.render.effects.charge.track_charge import THIN, Spread
from truesky.render.effects.effect import Effect, copy_frame, zero_contribution
from truesky.render.effects.scene import Frame, Scene

# Square centimetres per square micrometre.
_SQUARE_CM = 1e-8
# Name of the table in the mission database with cumulative probability, length (pixels) and charge (electrons) of the
# tracks of cosmic rays in VIS.
_TRACKS = "env.cosmic_rays.vis_tracks"
# Shortest length in pixels of a track, projected on the detector: the length for a muon perpendicular to the detector.
# It must not be 0, because the logarithm of the length is interpolated.
_SHORTEST = 1e-2
# If the expected number of tracks per exposure is at most this, `median_pixel` returns 0, so that no cosmic rays are
# drawn unless the user switches them on.
_NEGLIGIBLE = 1e-3
# Number of tracks that are drawn together. A track of average length takes 1.1 kB, so that those of an exposure of
# 1e6 s would take 27 GB.
_TOGETHER = 1 << 18
# The same for tracks whose charge spreads to other pixels, which take more memory.
_TOGETHER_WIDE = 1 << 13


def apply(
    frame: Frame, expected: float, quantiles: Frame, spread: Spread, rng: np.random.Generator, out: Frame | None = None
) -> Frame:
    """Draw the cosmic rays of an exposure, and add their charge to a frame.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons.
    expected : float
        Expected number of tracks on the frame, 0 to 1e8. The number drawn has a Poisson distribution.
    quantiles : float array, shape (q, 3)
        Distribution of tracks: cumulative probability (ascending), length in pixels and charge in electrons. Between
        rows, the logarithms of length and charge are interpolated linearly.
    spread : Spread
        Fluctuations of the charge along the tracks, and diffusion.
    rng : numpy.random.Generator
        Random generator of the tracks.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape (ny, nx)
        Electrons including cosmic rays, which add whole electrons.

    Raises
    ------
    OutOfRange
        If `expected` is outside its limits or NaN.
    """
    out = copy_frame(frame, out)
    _add_tracks(out, expected, quantiles, spread, rng)
    return out


def draw_tracks(
    shape: tuple[int, ...], expected: float, quantiles: Frame, rng: np.random.Generator, spread: Spread = THIN
) -> Frame:
    """Draw an image that contains only the charge of random cosmic rays.

    Parameters
    ----------
    shape : (int, int)
        Number of rows and columns.
    expected : float
        Expected number of tracks on the image, 0 to 1e8. The number drawn has a Poisson distribution.
    quantiles : float array, shape (q, 3)
        Distribution of tracks: cumulative probability (ascending), length in pixels and charge in electrons. Between
        rows, the logarithms of length and charge are interpolated linearly.
    rng : numpy.random.Generator
        Random generator of the tracks.
    spread : Spread, optional
        Fluctuations of the charge along the tracks, and diffusion. By default, tracks are thin lines.

    Returns
    -------
    float array, shape (ny, nx)
        Electrons, whole numbers.

    Raises
    ------
    OutOfRange
        If `expected` is outside its limits or NaN.

    Notes
    -----
    A track that leaves the image at one edge continues at the opposite edge. These parts replace tracks that start
    outside the image and enter it, so that the density of tracks is uniform.
    """
    out = np.zeros(shape)
    _add_tracks(out, expected, quantiles, spread, rng)
    return out


def _add_tracks(out: Frame, expected: float, quantiles: Frame, spread: Spread, rng: np.random.Generator) -> None:
    count = draw_event_count(expected, rng)
    if out.size:
        ny, nx = out.shape
        for batch in batches(count, spread):
            events = draw_events(batch, ny, nx, quantiles, rng)
            _, column, row, charge = track_charge.distribute(events, pixels_of_events(events), spread, rng)
            add_charge(out, row, column, charge)


@jit
def add_charge(frame: Any, row: Any, column: Any, charge: Any) -> None:
    """Add charge to pixels of a frame in place. Positions outside the frame wrap around to the opposite edge.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons.
    row, column : int array, shape (n,)
        Row and column indices. They may be negative or larger than the frame, and may repeat.
    charge : float array, shape (n,)
        Electrons to add to each pixel.
    """
    ny, nx = frame.shape
    for i in range(len(charge)):
        frame[row[i] % ny, column[i] % nx] += charge[i]


def draw_event_count(expected: float, rng: np.random.Generator) -> int:
    """Draw the number of cosmic rays from a Poisson distribution with the mean `expected`.

    OutOfRange is raised if the mean is outside 0 to 1e8 or NaN.
    """
    if not 0.0 <= expected <= 1e8:
        raise OutOfRange("cosmic rays", expected, 0.0, 1e8)
    return int(rng.poisson(expected))


def batches(count: int, spread: Spread = THIN) -> Iterator[int]:
    """Yield the sizes of the groups in which `count` tracks are drawn, to limit the memory that they take."""
    together = _TOGETHER if spread.is_thin else _TOGETHER_WIDE
    for drawn in range(0, count, together):
        yield min(together, count - drawn)


def draw_events(count: int, ny: int, nx: int, quantiles: Frame, rng: np.random.Generator) -> tuple[Any, ...]:
    """Draw the start, direction, length and charge of cosmic-ray tracks.

    Parameters
    ----------
    count : int
        Number of tracks.
    ny, nx : int
        Number of rows and columns of the area in which tracks start.
    quantiles : float array, shape (q, 3)
        Distribution of tracks: cumulative probability (ascending), length in pixels and charge in electrons. Between
        rows, the logarithms of length and charge are interpolated linearly.
    rng : numpy.random.Generator
        Random generator of the tracks.

    Returns
    -------
    x, y : float array, shape (count,)
        Start of each track in pixels, uniform between 0 and nx or ny.
    cosine, sine : float array, shape (count,)
        Direction of each track: cosine and sine of the angle from the columns axis x to the rows axis y.
    length : float array, shape (count,)
        Length of each track, projected on the detector, in pixels.
    electrons : float array, shape (count,)
        Charge of each track in electrons, whole numbers.

    Notes
    -----
    Length and charge of a track have the same quantile, as in Niemi 2015: a longer path through the silicon leaves more
    charge.
    """
    chance, length, charge = quantiles.T
    angle = 2.0 * np.pi * rng.random(count)
    x, y, rank = nx * rng.random(count), ny * rng.random(count), rng.random(count)
    electrons = np.rint(np.exp(np.interp(rank, chance, np.log(charge))))
    return x, y, np.cos(angle), np.sin(angle), np.exp(np.interp(rank, chance, np.log(length))), electrons


@jit
def pixels_of_events(events: tuple[Any, ...]) -> Any:
    """Find the pixels that cosmic-ray tracks cross, and the charge that they leave in each.

    Parameters
    ----------
    events : tuple of float arrays, shape (count,)
        Start x and y, cosine and sine of the direction, length (pixels) and charge (electrons) of the tracks: the
        result of `draw_events`. Lengths must be more than 0.

    Returns
    -------
    event : int array, shape (n,)
        Index of the track, for each of the n crossings of a pixel by a track.
    column, row : int array, shape (n,)
        Position of the pixel. It may be outside the detector; `add_charge` wraps such positions around.
    charge : float array, shape (n,)
        Charge left in the pixel in electrons, whole numbers. Their sum over a track is the charge of the track.
    """
    x, y, cosine, sine, length, electrons = events
    size = 0
    for i in range(len(x)):
        # Upper limit on the number of pixels that a track crosses: each step leads to the next column or the next row.
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
            # The cumulative charge along the track is rounded. Its differences are whole numbers and add up to the
            # track's charge.
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
    """Return the number of cosmic rays per second that hit an area of the detector.

    Parameters
    ----------
    scene : Scene
        Settings of the exposure. A ground camera has the rate of its site; in space the rate follows from the flux of
        particles in the mission database.
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
    """Return the distribution of cosmic-ray tracks, float64[q, 3]: cumulative probability, length (pixels), electrons.

    For a ground camera it is computed for muons, otherwise it is the table in the mission database.
    """
    if f"{scene.section}.cosmic_rays.rate" in scene.mission:
        deposit = scene.mission.value("env.cosmic_rays.silicon_deposit", "electron / um")
        return muon_quantiles(
            scene.value("cosmic_rays.thickness", "um"), scene.value("fpa.pixel_size", "um / pix"), deposit
        )
    return np.array(scene.mission.numbers(_TRACKS))


def muon_quantiles(thickness: float, pixel: float, deposit: float) -> Frame:
    """Return the distribution of the tracks of muons through a horizontal detector.

    Parameters
    ----------
    thickness, pixel : float
        Thickness of the silicon in micrometres, and size of a pixel in micrometres.
    deposit : float
        Charge per path length in electrons per micrometre.

    Returns
    -------
    float array, shape (55, 3)
        Cumulative probability (ascending from 0 to 1), projected length in pixels, and charge in electrons.

    Notes
    -----
    The intensity of muons is proportional to cos^2 of the zenith angle, and their flux through the detector to cos^3.
    Not modelled: fluctuations of the energy loss, electrons from radioactivity, and the tilt of the detector.
    """
    cumulative = np.append(np.linspace(0.0, 0.98, 50), [0.99, 0.999, 0.9999, 1.0 - 1e-6])
    cosine = (1.0 - cumulative) ** 0.25
    length = np.maximum(thickness * np.sqrt(1.0 - cosine**2) / (cosine * pixel), _SHORTEST)
    table = np.stack([cumulative, length, deposit * thickness / cosine], axis=1)
    return np.concatenate([table, [[1.0, 1.001 * table[-1, 1], 1.001 * table[-1, 2]]]])


def _expected_events(scene: Scene) -> float:
    return event_rate(scene, float(scene.nx * scene.ny)) * scene.exposure_time_s


def brightest_pixel(scene: Scene) -> float:
    """Return the highest charge in electrons that a cosmic ray leaves in one pixel.

    It is the maximum over the rows of `track_quantiles`. A track shorter than a pixel leaves its whole charge in one
    pixel, a longer one the charge per pixel of its length, times the largest fluctuation.
    """
    _, length, charge = track_quantiles(scene).T
    highest = track_charge.of_scene(scene).largest_fluctuation
    return float(np.minimum(highest * charge / np.maximum(length, 1.0), charge).max())


def median_pixel(scene: Scene, expected: float) -> float:
    """Return the charge per pixel of length of the median cosmic-ray track in electrons.

    It is 0 if the expected number of tracks, `expected`, is not above 1e-3.
    """
    _, length, charge = track_quantiles(scene).T
    middle = len(length) // 2
    return float(charge[middle] / length[middle]) * (expected > _NEGLIGIBLE)


EFFECT = Effect(
    "cosmic_rays",
    apply,
    lambda scene: (_expected_events(scene), track_quantiles(scene), track_charge.of_scene(scene)),
    lambda scene: median_pixel(scene, _expected_events(scene)),
    cost=4e-3,
    systematic=zero_contribution,
    in_place=True,
)
