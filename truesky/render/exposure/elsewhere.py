"""What the detectors that share a board with one hold while it is read: their bright stars, drawn from the catalogue.

No detector needs the image of another: what it sees of them is a function of the plan and the catalogue alone.
Error : stars alone are drawn, in the colour of flat f_nu, through the PSF of the detector that sees them, without
        spikes beyond its planes, noise and cosmic rays; nothing but the full well changes their charge

neighbours   the other detectors of a board
may_show     whether the brightest of their pixels would be noticed
stars        of the catalogue, those that are bright enough;  circle : where they are
charge       what they bring, in the order in which all are read
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from lake_schema.arrays import Float, Int
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.store import read
from lake_schema.tables.exposures import ExposureRow
from truesky.render.camera import astrometry, detectors
from truesky.render.camera.detectors import Detector
from truesky.render.channels.aim import Aim, electron_rate
from truesky.render.drawing import stamp_sizes, stamps
from truesky.render.drawing.settings import settings_for
from truesky.render.effects.charge import bleeding
from truesky.render.effects.readout import detector_crosstalk
from truesky.render.effects.scene import NOTICEABLE, Elsewhere, Frame, Scene
from truesky.render.exposure import scene_of, visible_sources
from truesky.render.exposure.records import Beside, Rows, Variant
from truesky.render.exposure.visible_sources import Light
from truesky.render.psf.model import Psf
from truesky.render.sources import catalogue_rows, selection
from truesky.render.sources.galaxy_shapes import shapes
from truesky.render.sources.source_list import Sources

_EFFECT = detector_crosstalk.EFFECT
# Of a point's light in its brightest pixel, at the most.
_PEAK = 0.3
# Of what would be noticed, what is left out of their images in a pixel.
_LEFT_OUT = 0.05


def neighbours(camera: str, name: str, mission: MissionConfiguration) -> tuple[Detector, ...]:
    """The detectors that are read with one: of the camera's order so many are on a board."""
    every = detectors.detectors(camera, mission)
    key = f"{every[0].section}.fpa.board"
    many = int(mission.value(key)) if key in mission else 1
    first = [d.name for d in every].index(name) // many * many
    return tuple(d for d in every[first : first + many] if d.name != name)


def may_show(aim: Aim, variant: Variant) -> bool:
    """Whether a full pixel of another detector would be noticed; or the effect is forced on."""
    if _EFFECT not in aim.effects or not aim.sees_sky:
        return False
    scene = scene_of.of_aim(aim, variant)
    most = abs(detector_crosstalk.coefficient(scene)) * bleeding.capacity(scene)
    return bool(most > 0.0 and variant.forced.get(_EFFECT.name, most > NOTICEABLE * scene.pixel_noise))


def circle(exposure: ExposureRow, detector: Detector) -> dict[str, float]:
    """ra, dec, radius (deg) about a detector, as of a task."""
    system = astrometry.wcs(detector, exposure.ra, exposure.dec, exposure.position_angle)
    ra, dec = astrometry.centre(detector, system)
    # Optics may show it a little more of the sky.
    return {"ra": ra, "dec": dec, "radius": 1.05 * detector.half_diagonal / 3600.0}


def stars(inputs: Mapping[str, read.Version], aim: Aim, variant: Variant) -> tuple[Beside, ...]:
    """Of each other detector of the board the stars that may be noticed.

    inputs : versions of the tables that are read;  aim, variant : of the detector that sees them
    """
    exposure = aim.exposure
    if not may_show(aim, variant):
        return ()
    least = _least(scene_of.of_aim(aim, variant)) / (_PEAK * electron_rate(exposure) * exposure.exposure_time_s)
    beside = neighbours(exposure.camera, aim.detector.name, variant.mission)
    wanted = [
        catalogue_rows.Bright(circle(exposure, other), visible_sources.STAR_COLUMNS, exposure.band, least)
        for other in beside
    ]
    found = catalogue_rows.bright(inputs["stars"], inputs["star_fluxes"], wanted)
    return tuple(Beside(other, *rows) for other, rows in zip(beside, found, strict=True))


def _least(scene: Scene) -> float:
    """Electrons in a pixel of another detector that are noticed."""
    return NOTICEABLE * scene.pixel_noise / abs(detector_crosstalk.coefficient(scene))


def with_charge(light: Light, aim: Aim, rows: Rows, variant: Variant, seed: int) -> Light:
    """The light, whose scene has what the others bring.

    light : of the detector;  aim : the exposure and detector;  rows : with the stars of the other detectors
    variant : mission, accuracy and the effects that are forced on or off;  seed : of the request
    """
    if not rows.beside or light.psf is None:
        return light
    return replace(light, scene=replace(light.scene, elsewhere=charge(light, aim, rows, variant, seed)))


def charge(light: Light, aim: Aim, rows: Rows, variant: Variant, seed: int) -> Elsewhere | None:
    """Of all the other detectors, in the order in which the detector's own pixels are read; None: nothing.

    light, aim, rows, variant, seed : as of `with_charge`
    """
    assert light.psf is not None
    scene, psf = light.scene, replace(light.psf, edges=None)
    least = _least(scene)
    apart = aim.channel.readout.apart
    shape = apart(np.zeros((scene.ny, scene.nx), np.uint8), scene).shape
    pixels: list[Int] = [np.zeros(0, np.int64)]
    electrons: list[Float] = [np.zeros(0)]
    for beside in rows.beside:
        there = Aim.of(aim.exposure, beside.detector, aim.band, seed)
        sources = _sources(there, beside, rows, psf, least)
        if not len(sources):
            continue
        settings = settings_for(variant.accuracy)
        sizes = stamp_sizes.stamp_sizes(sources.electrons, sources.shape, sources.shapes, psf, least, settings)
        own = scene_of.of_aim(there, variant)
        frame = stamps.draw(sources, sizes, psf, there.detector.nx, there.detector.ny)
        planes = apart(_held(frame, own), own)
        some = np.argwhere(planes > _LEFT_OUT * least)
        # A detector of another kind has others.
        some = some[(some < shape).all(axis=1)]
        pixels.append(np.asarray(np.ravel_multi_index(tuple(some.T), shape), np.int64))
        electrons.append(planes[tuple(some.T)])
    found, number = np.unique(np.concatenate(pixels), return_inverse=True)
    if not len(found):
        return None
    return Elsewhere(found, np.asarray(np.bincount(number, np.concatenate(electrons), len(found)), float))


def _held(frame: Frame, scene: Scene) -> Frame:
    """Whole electrons that the pixels hold."""
    return bleeding.apply(np.maximum(np.floor(frame), 0.0), bleeding.capacity(scene), scene.runs)


def _sources(there: Aim, beside: Beside, rows: Rows, psf: Psf, least: float) -> Sources:
    """The stars of another detector that have so many electrons in a pixel, where they are on it."""
    exposure, detector = there.exposure, there.detector
    middle = exposure.mjd + 0.5 * exposure.exposure_time_s / 86400.0
    moved = catalogue_rows.at_time(beside.stars, middle)
    electrons = visible_sources.fluxes_of(moved, beside.fluxes, f"f_nu_{exposure.band}") * there.electrons
    column, row = astrometry.pixel_of_sky(there.wcs, moved["ra"].to_numpy(), moved["dec"].to_numpy())
    here = selection.touching(column, row, np.zeros(len(column)), detector.nx, detector.ny)
    ids = np.asarray(moved["id"].to_numpy())
    kept = np.flatnonzero(here & (electrons * float(psf.surface[0]) > least))
    kept = kept[np.argsort(ids[kept], kind="stable")]
    jacobian = astrometry.jacobian(there.wcs, column[kept], row[kept])
    none = np.full(len(kept), -1)
    forms = shapes(rows.galaxies.slice(0, 0))
    return Sources(ids[kept], column[kept], row[kept], jacobian, electrons[kept], none, forms)
