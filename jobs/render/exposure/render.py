"""One detector of one exposure: catalogue rows in, a raw image and its noise-free truth out.

render          the whole of it
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from jobs import rng
from jobs.accuracy import Accuracy
from jobs.fluxes import passbands
from jobs.fluxes.libraries.templates import Library
from jobs.fluxes.passbands import Passband
from jobs.render.camera import astrometry, detectors
from jobs.render.camera.detectors import Detector
from jobs.render.channels import image_types, registry, vis
from jobs.render.drawing import stamp_sizes, stamps
from jobs.render.drawing.settings import settings_for
from jobs.render.effects.effect import Decision, Effect, apply_all, decide
from jobs.render.exposure import bright_lights, limits, rendered, scene_of, truth_maps, visible_sources
from jobs.render.exposure.rendered import Rendered
from jobs.render.psf import euclid, from_file, model, seeing
from jobs.render.psf.model import Psf
from jobs.render.sources import solar_system
from lake_schema.arrays import Row
from lake_schema.ids import kind_of
from lake_schema.mission.configuration import MissionConfiguration

# Code of a star in an identifier.
_STAR = 5


def render(
    task: Row,
    exposure: Row,
    galaxies: pa.Table,
    galaxy_fluxes: pa.Table,
    stars: pa.Table,
    star_fluxes: pa.Table,
    mission: MissionConfiguration,
    accuracy: Accuracy,
    seed: int,
    forced: Mapping[str, bool] | None = None,
    detector: Detector | None = None,
    progress: Callable[[int], None] | None = None,
    library: Library | None = None,
    stellar: Library | None = None,
    passband: Passband | None = None,
    complete: float = 0.0,
    truth: Sequence[str] = (),
    lenses: pa.Table | None = None,
    bodies: Callable[[int], solar_system.Population] | None = None,
) -> Rendered:
    """Render one detector.

    task, exposure : rows of the tables `tasks` and `exposures`
    galaxies ..    : rows that may touch the detector (GALAXY_COLUMNS, STAR_COLUMNS) and, row by row, their
                     f_nu in the band
    forced         : effect name -> on or off, instead of what the scene needs
    library        : what the galaxies' sed_1 and sed_2 count, stellar : what the stars' sed, None = the embedded ones
    passband       : the exposure's, None = the embedded one of its name
    detector       : another geometry than the mission's for task["detector"], e.g. a part of it
    complete       : how far beyond the detector the rows have every source, arcsec; for the header
    truth          : maps that are wanted besides the noise-free one, of lake_schema.tables.products.CONTENTS
    lenses         : rows of `strong_lenses` (pictures.ARC_COLUMNS) whose sources are among the galaxies
    bodies         : a day's moving bodies (own_bodies.Bodies.of_day), None = the embedded population
    """
    camera, band, channel = str(exposure["camera"]), str(exposure["band"]), str(exposure["channel"])
    passband = passband or passbands.load(band)
    effects = registry.effects_of(channel, str(exposure["image_type"]), f"exposure {exposure['exposure_id']}")
    if detector is None:
        detector = detectors.detector(camera, str(task["detector"]), mission)
    system = astrometry.wcs(detector, exposure["ra"], exposure["dec"], exposure["position_angle"])
    zero_point, scene = float(exposure["zero_point"]), scene_of.scene_of(exposure, detector, mission, accuracy)
    scene = replace(scene, band=passband, forced=forced or {})
    decisions: tuple[Decision, ...] = ()
    spread: Psf | None = None
    maps: dict[str, npt.NDArray[Any]] = {}
    sources, sizes, drawn = visible_sources.no_sources(galaxies), np.zeros(0, np.int64), np.zeros(0)
    if image_types.sees_sky(channel, str(exposure["image_type"])):
        electrons = [
            visible_sources.fluxes(rows, fluxes, f"f_nu_{band}")
            * scene_of.electron_rate(exposure)
            * scene.exposure_time_s
            for rows, fluxes in ((galaxies, galaxy_fluxes), (stars, star_fluxes))
        ]
        settings = settings_for(accuracy)
        spread = model.of_colours(_psf(exposure, detector, passband, mission, settings.positions), settings.colours)
        sources, sizes = visible_sources.sources_of(
            (galaxies, electrons[0]), (stars, electrons[1]), detector, system, spread, scene.pixel_noise, settings,
            passband, library, stellar, lenses,
        )  # fmt: skip
        if channel == "VIS":
            sources, sizes, bright = visible_sources.with_moving(
                sources, sizes, exposure, detector, system, passband, scene, spread, settings, seed, bodies
            )
            lights = bright_lights.bright_lights(
                (galaxies, electrons[0]), (stars, electrons[1]), detector, system
            ).and_those(bright)
            brightest = sources.electrons[limits.touching(sources, sizes, detector)].max(initial=0.0)
            peak = float(spread.surface[0]) * float(brightest)
            scene = replace(scene, lights=lights, peak_electrons=peak)
            decisions = decide((vis.DRAWN,), scene)
            if decisions[0].applied and spread.intra_pixel is not None:
                (strength,) = vis.DRAWN.parameters(scene)
                spread = replace(spread, intra_pixel=strength)
        limits.refuse_too_large(exposure, detector, sources, sizes, spread)
        floors = stamp_sizes.floors(sources.electrons, scene.pixel_noise, settings)
        drawn = np.zeros(len(sources))
        noise_free = stamps.draw(
            sources, sizes, spread, detector.nx, detector.ny, progress, floors, drawn, scene.unread
        )
        halves = noise_free[: scene.unread[0]], noise_free[scene.unread[1] :]
        scene = replace(scene, peak_electrons=max(float(half.max(initial=0.0)) for half in halves))
        if "stars" in truth:
            of_stars = kind_of(sources.ids) == _STAR
            maps["stars"] = stamps.draw(
                sources.take(of_stars), sizes[of_stars], spread, detector.nx, detector.ny, None, floors[of_stars]
            ).astype(np.float32)
        # What sends in no more than faint wings is drawn, not listed.
        a_piece = sources.electrons / stamp_sizes.piece_count(sources.length)
        listed = (drawn > 0.0) | stamp_sizes.shining(a_piece, sizes, sources.shape, sources.picture, spread)
        sources, sizes, drawn = sources.take(listed), sizes[listed], drawn[listed]
    else:
        noise_free = np.zeros((detector.ny, detector.nx))
    scene = scene_of.with_own_light(scene, effects)
    maps["noise_free"] = noise_free.astype(np.float32)
    # Handed over: a frame that nobody looks at any more is freed.
    light = [noise_free]
    del noise_free

    def stream(effect: Effect) -> np.random.Generator:
        return rng.stream(*rendered.numbers_of(effect, exposure, detector.name, seed))

    frame, more = apply_all(light.pop(), effects, scene, stream, truth_maps.watch(maps, scene, truth))
    raw = frame.astype(np.uint16)
    truth_maps.complete(maps, raw, effects, scene, truth)
    return Rendered(
        exposure, detector, system, spread, raw, maps, sources, sizes, drawn, zero_point, scene, (*decisions, *more),
        accuracy, seed, complete,
    )  # fmt: skip


def _psf(exposure: Row, detector: Detector, band: Passband, mission: MissionConfiguration, positions: int) -> Psf:
    if exposure.get("psf"):
        return from_file.read(from_file.file_of(exposure["psf"], detector.name), detector, band)
    if detector.section == "vis":
        return euclid.vis_psf(detector, band, mission, positions)
    beta = mission.value(f"{detector.section}.psf.moffat_beta")
    return seeing.ground_psf(float(exposure["seeing"]), beta, detector.pixel_scale)
