"""Ghosts of bright stars in ground cameras: light that two surfaces of lenses, filter or detector reflect.

A ghost is a defocused image of the pupil, an annulus of uniform surface brightness. The mission database has a table of
the brightest ghosts of a camera and band, with positions and sizes for several distances of the star from the optical
axis (scripts/trace_optics.py), and the reflectances of glass and detector. Shadows of the spider and the change of the
annulus into an ellipse are neglected, and so is light from stars that are too far from the detector to be read.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.camera.detectors import detectors, field_radius
from truesky.render.effects.effect import Effect, copy_frame
from truesky.render.effects.scene import Frame, Scene
from truesky.render.psf.aberrations import Telescope

# Smallest radius of a ghost, pixels. A smaller ghost would be in the core of its star.
_SMALLEST = 10.0


class Annuli(NamedTuple):
    """Annuli of uniform surface brightness.

    Attributes
    ----------
    column, row : float array, shape (n,)
        Position of the centre, pixels.
    radius : float array, shape (n,)
        Outer radius, pixels.
    level : float array, shape (n,)
        Electrons per pixel.
    """

    column: Float
    row: Float
    radius: Float
    level: Float


class _Ghost(NamedTuple):
    """A ghost by the distance of its star from the axis, relative to the farthest corner of the camera.

    `distance`, `centre` (position relative to that of the star), `radius` (pixels) and `passed` (fraction of the star's
    light that arrives) are arrays with the same number of elements.
    """

    distance: Float
    centre: Float
    radius: Float
    passed: Float


def apply(
    frame: Frame, annuli: Annuli, hole: float, rng: np.random.Generator | None = None, out: Frame | None = None
) -> Frame:
    """Add annuli to a frame.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons.
    annuli : Annuli
        The ghosts, also with centres outside the frame.
    hole : float
        Inner radius relative to the outer radius, 0 to 0.99.
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
        If `hole` is outside its limits.
    """
    if not 0.0 <= hole <= 0.99:
        raise OutOfRange("ghost hole", hole, 0.0, 0.99)
    out = copy_frame(frame, out)
    _add_annuli(out, annuli.column, annuli.row, annuli.radius, annuli.level, hole)
    return out


@jit
def _add_annuli(frame: Any, column: Any, row: Any, radius: Any, level: Any, hole: float) -> None:
    """Add annuli to a frame, in place. Their edges are ramps one pixel wide."""
    ny, nx = frame.shape
    for i in range(len(column)):
        outer, inner = radius[i], hole * radius[i]
        for r in range(max(0, int(np.ceil(row[i] - outer - 1.0))), min(ny, int(np.floor(row[i] + outer + 1.0)) + 1)):
            half = np.sqrt(max((outer + 1.0) ** 2 - (r - row[i]) ** 2, 0.0))
            for c in range(max(0, int(np.ceil(column[i] - half))), min(nx, int(np.floor(column[i] + half)) + 1)):
                distance = np.sqrt((c - column[i]) ** 2 + (r - row[i]) ** 2)
                covered = min(max(0.5 + outer - distance, 0.0), 1.0) * min(max(0.5 + distance - inner, 0.0), 1.0)
                frame[r, c] += level[i] * covered


def ghost_level(scene: Scene) -> float:
    """Return the electrons per pixel in the brightest ghost of a star of one electron; 0 without a table of ghosts."""
    return max((float(np.max(_level(ghost, 1.0, scene))) for ghost in _ghosts(scene)), default=0.0)


def min_noticeable_electrons(scene: Scene) -> float:
    """Return the electrons of the faintest star that has a noticeable ghost; infinite without ghosts."""
    level = ghost_level(scene)
    return scene.noticeable_mean_electrons / level if level else np.inf


def _hole(scene: Scene) -> float:
    pupil = Telescope.from_mission(scene.section, scene.mission)
    return pupil.inner / pupil.radius


def _level(ghost: _Ghost, electrons: float, scene: Scene) -> Float:
    area = np.pi * ghost.radius**2 * (1.0 - _hole(scene) ** 2)
    return np.asarray(electrons * ghost.passed / area)


def _ghosts(scene: Scene) -> list[_Ghost]:
    """Return the ghosts of the scene's camera and band, with the reflectances of both surfaces in `passed`."""
    key = f"{scene.section}.ghosts"
    if key not in scene.mission or scene.band is None:
        return []
    pixel = scene.value("fpa.pixel_size", "mm / pix")
    reflectance = {kind: scene.value(f"reflectance.{kind}", "") for kind in ("detector", "glass")}
    rows: dict[tuple[str, str], list[list[float]]] = {}
    for row in scene.mission.rows(key):
        if row["band"] == scene.band.name:
            numbers = [float(row[name]) for name in ("distance", "centre", "radius_mm", "passed")]
            rows.setdefault((row["first"], row["second"]), []).append(numbers)
    ghosts = []
    for (first, _), lines in rows.items():
        distance, centre, radius, passed = np.array(lines).T
        share = reflectance["glass"] * reflectance["detector" if first == "detector" else "glass"]
        ghosts.append(_Ghost(distance, centre, np.maximum(radius / pixel, _SMALLEST), share * passed))
    return ghosts


def in_focal_plane(
    scene: Scene, x: Float, y: Float, electrons: Float, reach: float
) -> Iterator[tuple[Float, Float, Float, Float]]:
    """Yield the ghosts of stars in the focal plane, for each pair of reflecting surfaces.

    Parameters
    ----------
    scene : Scene
        Settings of the exposure, with its passband.
    x, y : float array, shape (n,)
        Positions of the stars in the focal plane, arcsec.
    electrons : float array, shape (n,)
        Electrons expected from each star.
    reach : float
        Radius of the circle around all detectors of the camera, arcsec.

    Yields
    ------
    x, y : float array, shape (n,)
        Centres of the ghosts in the focal plane, arcsec.
    radius : float array, shape (n,)
        Outer radii, pixels.
    level : float array, shape (n,)
        Electrons per pixel.
    """
    distance_ratio = np.hypot(x, y) / reach
    for ghost in _ghosts(scene):
        centre, radius, passed = (np.interp(distance_ratio, ghost.distance, values) for values in ghost[1:])
        level = _level(_Ghost(distance_ratio, centre, radius, passed), 1.0, scene) * electrons
        yield centre * x, centre * y, radius, level


def parameters(scene: Scene) -> tuple[Annuli, float]:
    """Return the parameters of `apply`: the ghosts of the bright stars of a scene, and the hole of the pupil.

    Ghosts whose surface brightness is not noticeable in the mean of many pixels are left out.
    """
    detector, lights, parts = scene.detector, scene.lights, []
    if detector is None:
        return Annuli(*np.zeros((4, 0))), _hole(scene)
    first_column, first_row = (scene.window.column, scene.window.row) if scene.window is not None else (0, 0)
    places = detector.focal_plane_place(lights.column + first_column, lights.row + first_row)
    reach = field_radius(detectors(scene.section.rpartition(".")[2], scene.mission))
    for x, y, radius, level in in_focal_plane(scene, *places, lights.electrons, reach):
        column, row = detector.pixel_place(x, y)
        is_visible = level > scene.noticeable_mean_electrons
        for place, side in ((column, detector.nx), (row, detector.ny)):
            is_visible &= (place > -radius - 1.0) & (place < side + radius)
        parts.append(np.stack([column - first_column, row - first_row, radius, level])[:, is_visible])
    return Annuli(*np.concatenate([np.zeros((4, 0)), *parts], axis=1)), _hole(scene)


def _contribution(scene: Scene) -> float:
    """Return the electrons per pixel of the brightest possible ghost of the brightest star."""
    brightest = float(scene.lights.electrons.max(initial=0.0))
    return ghost_level(scene) * brightest if brightest else 0.0


EFFECT = Effect("lens_ghosts", apply, parameters, _contribution, cost=5e-3, in_place=True)
