"""Charge along the tracks of cosmic rays: fluctuations of the energy loss, and diffusion of charge to other pixels.

By default a track is a line that loses the same energy in each micrometre, as in Serrano et al. 2024. With straggling,
the energy loss in a path has a Moyal distribution, which approximates that of Landau: most parts of a track lose less
than the mean, a few much more. The variance is proportional to the path. A track keeps its total charge, whose
distribution is known, so that the mean energy does not change. With diffusion, charge spreads as a Gaussian about the
place where it is released.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy

from lake_schema.arrays import Float, Int
from lake_schema.errors import OutOfRange
from truesky.render.effects.scene import Scene

# Mean of the standard Moyal distribution: Euler's constant plus log 2.
_MOYAL_MEAN = float(np.euler_gamma + np.log(2.0))
# Charge spreads from points along the path in a pixel. Their distance is at most this many standard deviations, unless
# that takes more points than `_MOST_POINTS`.
_STEP, _MOST_POINTS = 1.2, 32
# Charge that spreads farther than this many standard deviations from the edge of a pixel is put into nearer pixels.
_REACH = 4.0
# Smallest path in pixels for which a fluctuation is drawn; the charge of a shorter one is negligible.
_SHORTEST = 1e-3
# Logarithm of the inverse square of the smallest normal random number among all paths of an exposure, with a margin.
_LARGEST = 40.0


class Spread(NamedTuple):
    """How the charge of a track is distributed.

    Attributes
    ----------
    diffusion : float
        Standard deviation of the spread of charge along columns and rows, pixels, 0 to 1.
    straggling : float
        Scale of the Moyal distribution of the energy loss in a path of one pixel, over its mean, 0 to 1.
    thickness : float
        Thickness of the silicon in pixels, which adds to the projected length of a path. Used for straggling only.
    """

    diffusion: float = 0.0
    straggling: float = 0.0
    thickness: float = 0.0

    @property
    def is_thin(self) -> bool:
        """True if tracks are thin lines with an even energy loss."""
        return self.diffusion == 0.0 and self.straggling == 0.0

    @property
    def largest_fluctuation(self) -> float:
        """Largest charge of a pixel over its mean."""
        return 1.0 + _LARGEST * self.straggling


THIN = Spread()


def of_scene(scene: Scene) -> Spread:
    """Return the spread of tracks in the camera of a scene; `THIN` if the mission database has none for the camera."""
    if f"{scene.section}.cosmic_rays.diffusion" not in scene.mission:
        return THIN
    thickness = scene.value("cosmic_rays.thickness", "um") / scene.value("fpa.pixel_size", "um / pix")
    return Spread(scene.value("cosmic_rays.diffusion", "pix"), scene.value("cosmic_rays.straggling", ""), thickness)


def distribute(
    events: tuple[Any, ...], crossings: tuple[Int, Int, Int, Float], spread: Spread, rng: np.random.Generator
) -> tuple[Int, Int, Int, Float]:
    """Distribute the charge of tracks with straggling and diffusion.

    Parameters
    ----------
    events : tuple of float arrays, shape (count,)
        Start x and y, cosine and sine of the direction, length (pixels) and charge (electrons) of the tracks.
    crossings : (int array, int array, int array, float array), shape (n,)
        For each crossing of a pixel by a track, in the order along the tracks: index of the track, column, row, and
        electrons for an even energy loss.
    spread : Spread
        Straggling and diffusion.
    rng : numpy.random.Generator
        Random generator of the fluctuations; not used without straggling.

    Returns
    -------
    tuple of arrays, shape (m,)
        As `crossings`: track, column, row and electrons of pixels that receive charge. Electrons are whole numbers,
        and their sum over a track is the charge of the track.

    Raises
    ------
    OutOfRange
        If the diffusion or the straggling is outside its limits or NaN.
    """
    for name, value in (("diffusion of cosmic rays", spread.diffusion), ("straggling", spread.straggling)):
        if not 0.0 <= value <= 1.0:
            raise OutOfRange(name, value, 0.0, 1.0)
    event, column, row, charge = crossings
    if spread.is_thin or not len(event):
        return crossings
    part = charge / np.maximum(events[5][event], 1.0)
    total = charge
    if spread.straggling:
        energy = part * _fluctuations(part * np.hypot(events[4], spread.thickness)[event], spread.straggling, rng)
        sums = np.bincount(event, energy, len(events[0]))[event]
        total = np.where(sums > 0.0, events[5][event] * energy / np.maximum(sums, 1e-300), charge)
    if spread.diffusion:
        event, column, row, total = _diffuse(events, (event, column, row, total), part, spread.diffusion)
    # The cumulative charge is rounded. It is a whole number at the end of each track.
    whole = np.diff(np.rint(np.cumsum(total)), prepend=0.0)
    has_charge = whole > 0.0
    return event[has_charge], column[has_charge], row[has_charge], whole[has_charge]


def _fluctuations(path: Float, straggling: float, rng: np.random.Generator) -> Float:
    """Draw the energy loss in paths (pixels), over its mean; 0 or more.

    Minus the logarithm of the square of a normal random number has the standard Moyal distribution.
    """
    moyal = -np.log(rng.standard_normal(len(path)) ** 2)
    scale = straggling / np.sqrt(np.maximum(path, _SHORTEST))
    return np.asarray(np.maximum(1.0 + scale * (moyal - _MOYAL_MEAN), 0.0))


def _diffuse(
    events: tuple[Any, ...], crossings: tuple[Int, Int, Int, Float], part: Float, sigma: float
) -> tuple[Int, Int, Int, Float]:
    """Spread the charge of each crossing from points along its path, and return it as crossings of more pixels.

    `part` is the length of each path over that of its track, and `sigma` the standard deviation in pixels.
    """
    event, column, row, total = crossings
    x, y, cosine, sine, length, _ = (values[event] for values in events)
    end = np.cumsum(part)
    # Subtract the paths of earlier tracks.
    first = np.flatnonzero(np.diff(event, prepend=-1))
    start = end - part
    start -= np.repeat(start[first], np.diff(first, append=len(event)))
    reach = max(1, int(np.ceil(_REACH * sigma - 0.5)))
    edges, weights = np.arange(-reach, reach + 2), np.zeros((len(event), 2 * reach + 1, 2 * reach + 1))
    points = min(int(np.ceil(np.sqrt(2.0) / (_STEP * sigma))), _MOST_POINTS)
    for point in range(points):
        along = length * (start + part * (point + 0.5) / points)
        shares = [
            np.diff(scipy.special.ndtr((edges - (at + step * along - pixel)[:, None]) / sigma), axis=1)
            for at, step, pixel in ((x, cosine, column), (y, sine, row))
        ]
        weights += shares[1][:, :, None] * shares[0][:, None, :]
    weights *= (total / weights.sum(axis=(1, 2)))[:, None, None]
    moved = np.arange(-reach, reach + 1)
    columns, rows = (
        np.broadcast_to(at, weights.shape).ravel()
        for at in (column[:, None, None] + moved[None, None, :], row[:, None, None] + moved[None, :, None])
    )
    return np.repeat(event, weights[0].size), columns, rows, weights.ravel()
