"""Bright stars on detectors that share a readout board with this one, for crosstalk between detectors.

No detector needs the image of another: its crosstalk depends only on the plan and the catalogue.

Only stars are drawn, with the colour of flat f_nu and with the PSF of the detector that receives the crosstalk. Not
included: spikes beyond the planes of the PSF, noise and cosmic rays. Only the full well changes their charge.
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
from truesky.render.effects.scene import NOTICEABLE, Frame, NeighbourCharge, Scene
from truesky.render.exposure import scene_factory, visible_sources
from truesky.render.exposure.records import NeighbourDetector, Rows, Variant
from truesky.render.exposure.visible_sources import Light
from truesky.render.psf.model import Psf
from truesky.render.sources import catalogue_rows, selection
from truesky.render.sources.galaxy_shapes import shapes
from truesky.render.sources.source_list import Sources

_EFFECT = detector_crosstalk.EFFECT
# Upper limit on the fraction of a point's flux in its brightest pixel.
_PEAK_FRACTION = 0.3
# Electrons of a pixel that are neglected in images of the stars, relative to the noticeable electrons.
_NEGLECTED = 0.05


def other_detectors(camera: str, name: str, mission: MissionConfiguration) -> tuple[Detector, ...]:
    """Return the other detectors on the readout board of a detector.

    Parameters
    ----------
    camera : str
        Camera.
    name : str
        Name of the detector.
    mission : MissionConfiguration
        Mission database. Its parameter `fpa.board` is the number of successive detectors per board, by default 1.

    Returns
    -------
    tuple of Detector
        Other detectors on the board.
    """
    all_detectors = detectors.detectors(camera, mission)
    key = f"{all_detectors[0].section}.fpa.board"
    board_size = int(mission.value(key)) if key in mission else 1
    board_start = [d.name for d in all_detectors].index(name) // board_size * board_size
    return tuple(d for d in all_detectors[board_start : board_start + board_size] if d.name != name)


def is_noticeable(aim: Aim, variant: Variant) -> bool:
    """Return True if a full pixel of another detector is noticeable in this one, or if the effect is forced on."""
    if _EFFECT not in aim.effects or not aim.sees_sky:
        return False
    scene = scene_factory.from_aim(aim, variant)
    max_electrons = abs(detector_crosstalk.coefficient(scene)) * bleeding.full_well(scene)
    return bool(
        max_electrons > 0.0 and variant.forced.get(_EFFECT.name, max_electrons > NOTICEABLE * scene.pixel_noise)
    )


def detector_circle(exposure: ExposureRow, detector: Detector) -> dict[str, float]:
    """Return the circle around a detector: ra, dec and radius in degrees, as in the table `tasks`."""
    wcs = astrometry.wcs(detector, exposure.ra, exposure.dec, exposure.position_angle)
    ra, dec = astrometry.centre(detector, wcs)
    # With distortion, the detector may cover slightly more of the sky.
    return {"ra": ra, "dec": dec, "radius": 1.05 * detector.half_diagonal / 3600.0}


def bright_stars(inputs: Mapping[str, read.Version], aim: Aim, variant: Variant) -> tuple[NeighbourDetector, ...]:
    """Read the stars on other detectors of the board that may be noticeable.

    Parameters
    ----------
    inputs : mapping of str to Version
        Versions of the tables `stars` and `star_fluxes`.
    aim : Aim
        Exposure and detector that receives the crosstalk.
    variant : Variant
        Mission, accuracy and forced effects of this detector.

    Returns
    -------
    tuple of NeighbourDetector
        Other detectors of the board with their stars; empty if crosstalk is not noticeable.
    """
    exposure = aim.exposure
    if not is_noticeable(aim, variant):
        return ()
    min_flux = _noticeable_electrons(scene_factory.from_aim(aim, variant)) / (
        _PEAK_FRACTION * electron_rate(exposure) * exposure.exposure_time_s
    )
    neighbours = other_detectors(exposure.camera, aim.detector.name, variant.mission)
    queries = [
        catalogue_rows.BrightQuery(
            detector_circle(exposure, neighbour), visible_sources.STAR_COLUMNS, exposure.band, min_flux
        )
        for neighbour in neighbours
    ]
    tables = catalogue_rows.read_bright(inputs["stars"], inputs["star_fluxes"], queries)
    return tuple(NeighbourDetector(neighbour, *rows) for neighbour, rows in zip(neighbours, tables, strict=True))


def _noticeable_electrons(scene: Scene) -> float:
    """Return the electrons in a pixel of another detector that are noticeable in this one."""
    return NOTICEABLE * scene.pixel_noise / abs(detector_crosstalk.coefficient(scene))


def with_neighbour_charge(light: Light, aim: Aim, rows: Rows, variant: Variant, seed: int) -> Light:
    """Add the charge of the other detectors to the scene of a light.

    Parameters
    ----------
    light : Light
        Light on the detector.
    aim : Aim
        Exposure and detector.
    rows : Rows
        Catalogue rows, with the stars of the other detectors.
    variant : Variant
        Mission, accuracy and forced effects.
    seed : int
        Seed of the request.

    Returns
    -------
    Light
        The light with the new scene.
    """
    if not rows.neighbours or light.psf is None:
        return light
    return replace(
        light, scene=replace(light.scene, neighbour_charge=neighbour_charge(light, aim, rows, variant, seed))
    )


def neighbour_charge(light: Light, aim: Aim, rows: Rows, variant: Variant, seed: int) -> NeighbourCharge | None:
    """Charge of all other detectors of the board, in the order in which this detector's pixels are read.

    Parameters
    ----------
    light, aim, rows, variant, seed : Light, Aim, Rows, Variant, int
        Same as in `with_neighbour_charge`.

    Returns
    -------
    NeighbourCharge or None
        Charge by pixel. None if there is no charge.
    """
    assert light.psf is not None
    scene, psf = light.scene, replace(light.psf, edges=None)
    min_electrons = _noticeable_electrons(scene)
    split_amplifiers = aim.channel.readout.split
    shape = split_amplifiers(np.zeros((scene.ny, scene.nx), np.uint8), scene).shape
    pixels: list[Int] = [np.zeros(0, np.int64)]
    electrons: list[Float] = [np.zeros(0)]
    for neighbour in rows.neighbours:
        neighbour_aim = Aim.from_exposure(aim.exposure, neighbour.detector, aim.band, seed)
        sources = _select_stars(neighbour_aim, neighbour, rows, psf, min_electrons)
        if not len(sources):
            continue
        settings = settings_for(variant.accuracy)
        sizes = stamp_sizes.stamp_sizes(sources.electrons, sources.shape, sources.shapes, psf, min_electrons, settings)
        neighbour_scene = scene_factory.from_aim(neighbour_aim, variant)
        frame = stamps.draw(sources, sizes, psf, neighbour_aim.detector.nx, neighbour_aim.detector.ny)
        planes = split_amplifiers(_bled_electrons(frame, neighbour_scene), neighbour_scene)
        pixel_indices = np.argwhere(planes > _NEGLECTED * min_electrons)
        # A detector of another kind may have pixels that this detector does not have.
        pixel_indices = pixel_indices[(pixel_indices < shape).all(axis=1)]
        pixels.append(np.asarray(np.ravel_multi_index(tuple(pixel_indices.T), shape), np.int64))
        electrons.append(planes[tuple(pixel_indices.T)])
    unique_pixels, inverse = np.unique(np.concatenate(pixels), return_inverse=True)
    if not len(unique_pixels):
        return None
    return NeighbourCharge(
        unique_pixels, np.asarray(np.bincount(inverse, np.concatenate(electrons), len(unique_pixels)), float)
    )


def _bled_electrons(frame: Frame, scene: Scene) -> Frame:
    """Return whole electrons per pixel after bleeding."""
    return bleeding.apply(np.maximum(np.floor(frame), 0.0), bleeding.full_well(scene), scene.column_segments)


def _select_stars(
    neighbour_aim: Aim, neighbour: NeighbourDetector, rows: Rows, psf: Psf, min_electrons: float
) -> Sources:
    """Return the stars that are on another detector and have more than `min_electrons` in a pixel."""
    exposure, detector = neighbour_aim.exposure, neighbour_aim.detector
    middle = exposure.mjd + 0.5 * exposure.exposure_time_s / 86400.0
    moved = catalogue_rows.apply_proper_motion(neighbour.stars, middle)
    electrons = (
        visible_sources.row_fluxes(moved, neighbour.fluxes, f"f_nu_{exposure.band}")
        * neighbour_aim.electrons_per_microjansky
    )
    column, row = astrometry.pixel_of_sky(neighbour_aim.wcs, moved["ra"].to_numpy(), moved["dec"].to_numpy())
    on_detector = selection.overlaps_frame(column, row, np.zeros(len(column)), detector.nx, detector.ny)
    ids = np.asarray(moved["id"].to_numpy())
    indices = np.flatnonzero(on_detector & (electrons * float(psf.surface[0]) > min_electrons))
    indices = indices[np.argsort(ids[indices], kind="stable")]
    jacobian = astrometry.jacobian(neighbour_aim.wcs, column[indices], row[indices])
    no_index = np.full(len(indices), -1)
    forms = shapes(rows.galaxies.slice(0, 0))
    return Sources(ids[indices], column[indices], row[indices], jacobian, electrons[indices], no_index, forms)
