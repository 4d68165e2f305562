"""Charge of bright stars on other detectors of the same readout board, which causes crosstalk on a detector.

The images of the other detectors are not needed: crosstalk depends only on the planned exposure and the catalogue. Only
stars are drawn on the other detectors, with constant f_nu and with the PSF of the detector that receives the crosstalk.
Diffraction spikes beyond the border of the PSF images, noise and cosmic rays are not included. The only effect that is
simulated in the other detectors is bleeding at the full well.
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
from truesky.render.drawing import stamp_sizes, stamps, wings
from truesky.render.drawing.drawn_units import DrawnUnits
from truesky.render.drawing.settings import settings_for
from truesky.render.effects.charge import bleeding
from truesky.render.effects.readout import detector_crosstalk
from truesky.render.effects.scene import Frame, NeighbourCharge, Scene
from truesky.render.exposure import scene_factory, visible_sources
from truesky.render.exposure.records import NeighbourDetector, Rows, Variant
from truesky.render.exposure.visible_sources import Light
from truesky.render.psf.model import Psf
from truesky.render.sources import catalogue_rows, selection, varying_stars
from truesky.render.sources.galaxy_shapes import shapes
from truesky.render.sources.source_list import Sources

_EFFECT = detector_crosstalk.EFFECT
# Upper limit of the fraction of a point source's flux in its brightest pixel. Stars on other detectors that cause no
# noticeable crosstalk even with this fraction are not read from the catalogue.
_PEAK_FRACTION = 0.3
# Pixels of other detectors are neglected if they have fewer electrons than this fraction of the number that causes
# noticeable crosstalk.
_NEGLECTED = 0.05


def other_detectors(camera: str, name: str, mission: MissionConfiguration) -> tuple[Detector, ...]:
    """Return the other detectors that are on the same readout board as a detector.

    Parameters
    ----------
    camera : str
        Name of the camera.
    name : str
        Name of the detector. ValueError is raised if the camera does not have it.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras). Its parameter `fpa.board` is the number of successive
        detectors per board, by default 1.

    Returns
    -------
    tuple of Detector
        The other detectors on the board; empty if the board has one detector.
    """
    all_detectors = detectors.detectors(camera, mission)
    key = f"{all_detectors[0].section}.fpa.board"
    board_size = int(mission.value(key)) if key in mission else 1
    board_start = [d.name for d in all_detectors].index(name) // board_size * board_size
    return tuple(d for d in all_detectors[board_start : board_start + board_size] if d.name != name)


def is_noticeable(aim: Aim, variant: Variant) -> bool:
    """Return True if crosstalk from other detectors on the readout board must be simulated for a detector.

    `aim` is the exposure and the detector, and `variant` contains the parameters of the simulation. Crosstalk is
    simulated if a pixel at the full well on another detector would change a pixel noticeably: by a tenth of its noise,
    or more if the request allows larger errors. A request can also switch crosstalk on or off. It is never simulated if
    no light of the sky reaches the detector, as in a dark image.
    """
    if _EFFECT not in aim.effects or not aim.sees_sky:
        return False
    scene = scene_factory.from_aim(aim, variant)
    max_electrons = abs(detector_crosstalk.coefficient(scene)) * scene.full_well
    return bool(max_electrons > 0.0 and variant.forced.get(_EFFECT.name, max_electrons > scene.noticeable_electrons))


def detector_circle(exposure: ExposureRow, detector: Detector) -> dict[str, float]:
    """Return a circle on the sky that contains a detector: its centre `ra` and `dec` and its `radius`, in degrees.

    The table `tasks` (one row per detector of an exposure) has columns with these three names and units.
    """
    wcs = astrometry.wcs(detector, exposure.ra, exposure.dec, exposure.position_angle)
    ra, dec = astrometry.centre(detector, wcs)
    # The radius is increased by 5 %, because with distortion the detector may cover slightly more of the sky.
    return {"ra": ra, "dec": dec, "radius": 1.05 * detector.half_diagonal / 3600.0}


def bright_stars(inputs: Mapping[str, read.Version], aim: Aim, variant: Variant) -> tuple[NeighbourDetector, ...]:
    """Read the bright stars on other detectors of a readout board that may cause noticeable crosstalk on a detector.

    Parameters
    ----------
    inputs : mapping of str to Version
        Tables `stars` and `star_fluxes` of the lake, by name.
    aim : Aim
        Exposure and detector that receives the crosstalk.
    variant : Variant
        Mission database, accuracy, and the effects that the request switches on or off.

    Returns
    -------
    tuple of NeighbourDetector
        Other detectors of the board with their bright stars; empty if crosstalk is not noticeable, or stars have no
        light in an exposure of 0 s.
    """
    exposure = aim.exposure
    electrons = _PEAK_FRACTION * electron_rate(exposure) * exposure.exposure_time_s
    if electrons == 0.0 or not is_noticeable(aim, variant):
        return ()
    min_flux = _noticeable_electrons(scene_factory.from_aim(aim, variant)) / electrons
    neighbours = other_detectors(exposure.camera, aim.detector.name, variant.mission)
    columns = varying_stars.add_columns(visible_sources.STAR_COLUMNS, inputs["stars"].schema.names)
    queries = [
        catalogue_rows.BrightQuery(detector_circle(exposure, neighbour), columns, exposure.band, min_flux)
        for neighbour in neighbours
    ]
    tables = catalogue_rows.read_bright(inputs["stars"], inputs["star_fluxes"], queries)
    return tuple(NeighbourDetector(neighbour, *rows) for neighbour, rows in zip(neighbours, tables, strict=True))


def _noticeable_electrons(scene: Scene) -> float:
    """Return how many electrons in a pixel of another detector cause just noticeable crosstalk in this detector.

    Crosstalk is noticeable above `scene.noticeable_electrons`. `scene` contains the properties of this detector and
    its exposure. The crosstalk coefficient must not be 0.
    """
    return scene.noticeable_electrons / abs(detector_crosstalk.coefficient(scene))


def neighbour_charge(light: Light, aim: Aim, rows: Rows, variant: Variant, seed: int) -> NeighbourCharge | None:
    """Return the charge on all other detectors of the board that is read at the same time as pixels of this detector.

    Parameters
    ----------
    light, aim, rows, variant, seed : Light, Aim, Rows, Variant, int
        Sources, PSF and scene (properties on which effects depend) of the detector that receives the crosstalk; its
        exposure and detector; catalogue rows with the other detectors and their stars in `neighbours`; mission database
        and accuracy; seed of the request.

    Returns
    -------
    NeighbourCharge or None
        Pixels of this detector, and for each the electrons of the other detectors that are read at the same time. None
        without other detectors, without a PSF, or if there is no noticeable charge.
    """
    if not rows.neighbours or light.psf is None:
        return None
    scene, psf = light.scene, replace(light.psf, edges=None)
    min_electrons = _noticeable_electrons(scene)
    readout_places, empty = aim.channel.readout.readout_places, np.zeros(0, np.int64)
    _, shape = readout_places(empty, empty, scene)
    pixels: list[Int] = [empty]
    electrons: list[Float] = [np.zeros(0)]
    for neighbour in rows.neighbours:
        neighbour_aim = Aim.from_exposure(aim.exposure, neighbour.detector, aim.band, seed)
        sources = _select_stars(neighbour_aim, neighbour, rows, psf, min_electrons)
        if not len(sources):
            continue
        settings = settings_for(variant.accuracy)
        sizes = stamp_sizes.stamp_sizes(sources.electrons, sources.shape, sources.shapes, psf, min_electrons, settings)
        neighbour_scene = scene_factory.from_aim(neighbour_aim, variant)
        drawn = stamps.draw_in_units(sources, sizes, psf, (neighbour_aim.detector.nx, neighbour_aim.detector.ny))
        rows_columns, charge = _charged_pixels(drawn, neighbour_scene, _NEGLECTED * min_electrons)
        places, _ = readout_places(*rows_columns, neighbour_scene)
        # A detector of another type may have more pixels than this detector. They are read when this detector reads no
        # pixel, so they are removed.
        is_read = ((places >= 0) & (places < shape)).all(axis=1)
        pixels.append(np.asarray(np.ravel_multi_index(tuple(places[is_read].T), shape), np.int64))
        electrons.append(charge[is_read])
    unique_pixels, inverse = np.unique(np.concatenate(pixels), return_inverse=True)
    if not len(unique_pixels):
        return None
    return NeighbourCharge(
        unique_pixels, np.asarray(np.bincount(inverse, np.concatenate(electrons), len(unique_pixels)), float)
    )


def _charged_pixels(drawn: DrawnUnits, scene: Scene, threshold: float) -> tuple[tuple[Int, Int], Float]:
    """Return rows and columns, and electrons after bleeding, of the pixels with more than `threshold` electrons.

    `drawn` is the light of the stars on the detector of `scene`. Charge bleeds along columns only, and few columns have
    stars that are bright enough, so that only these columns are computed.
    """
    rows, columns, electrons = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros(0)]
    for first, past in _bright_columns(drawn, threshold):
        charge = _bled_electrons(drawn.electrons_of_columns(first, past), first, scene)
        row, column = np.nonzero(charge > threshold)
        rows.append(row)
        columns.append(column + first)
        electrons.append(charge[row, column])
    return (np.concatenate(rows), np.concatenate(columns)), np.concatenate(electrons)


def _bright_columns(drawn: DrawnUnits, threshold: float) -> list[tuple[int, int]]:
    """Return (first, last + 1) of groups of columns that contain all pixels with more than `threshold` electrons.

    The groups begin at the borders of the blocks in which the light beyond stamps is stored. `drawn` is the light of
    the stars on the detector.
    """
    nx = drawn.frame.shape[1]
    blocks = np.unique(np.flatnonzero(drawn.max_of_columns() > threshold) // wings.BLOCK)
    groups = np.split(blocks, np.flatnonzero(np.diff(blocks) > 1) + 1) if len(blocks) else []
    return [(int(group[0]) * wings.BLOCK, min((int(group[-1]) + 1) * wings.BLOCK, nx)) for group in groups]


def _bled_electrons(frame: Frame, first: int, scene: Scene) -> Frame:
    """Return the electrons per pixel after charge above the full well has bled along the columns.

    `frame` contains the expected electrons per pixel, from column `first` of the detector on. They are first rounded
    down to whole electrons, and negative numbers are set to 0. `scene` contains the properties of the detector, such as
    its full well.
    """
    whole = np.floor(frame)
    np.maximum(whole, 0.0, out=whole)
    full_wells, segments = bleeding.parameters(scene)
    if isinstance(full_wells, np.ndarray):
        full_wells = full_wells[:, first : first + whole.shape[1]]
    return bleeding.apply(whole, full_wells, segments)


def _select_stars(
    neighbour_aim: Aim, neighbour: NeighbourDetector, rows: Rows, psf: Psf, min_electrons: float
) -> Sources:
    """Return the stars on another detector that have more than `min_electrons` in their brightest pixel.

    `neighbour_aim` is the exposure with the other detector, and `neighbour` contains its catalogue stars.
    """
    exposure, detector = neighbour_aim.exposure, neighbour_aim.detector
    middle = exposure.middle_mjd
    moved = catalogue_rows.apply_proper_motion(neighbour.stars, middle)
    fluxes = varying_stars.fluxes_at(moved, neighbour.fluxes, {exposure.band: neighbour_aim.band}, middle)
    electrons = (
        visible_sources.row_fluxes(moved, fluxes, f"f_nu_{exposure.band}") * neighbour_aim.electrons_per_microjansky
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
