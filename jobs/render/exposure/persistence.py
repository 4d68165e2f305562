"""What earlier exposures of a detector left in it: each is drawn again from the catalogue, without noise.

No exposure needs the image of another, so that they are rendered in any order: what is left is a function of the
planned exposures and the catalogue alone.  Of an earlier exposure are drawn the sources that leave something, its sky
and its lamp.

earlier_of        the tasks before a task
least_flux        f_nu of the faintest source of an earlier exposure that is drawn again
remembered        what they left
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from jobs.render.channels import registry
from jobs.render.channels.aim import Aim, electron_rate
from jobs.render.drawing import stamps
from jobs.render.drawing.settings import settings_for
from jobs.render.effects.charge.persistence import Traps
from jobs.render.effects.scene import Frame, Scene
from jobs.render.exposure import scene_of, standard_stars, visible_sources
from jobs.render.exposure.records import Earlier, Rows, Variant
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow

_DAY_S, _HOUR_S = 86400.0, 3600.0
# Electrons of the faintest source that is drawn again so many seconds later, and of a pixel's light that stamps leave
# out; more where more time has passed.  Measured: a pixel of the next exposure is wrong by 1.3 e- at the most.
_LEAST, _LEFT_OUT, _SECONDS = 700.0, 100.0, 134.0

Task = Mapping[str, Any]


def earlier_of(
    tasks: Iterable[Task], exposures: Mapping[int, ExposureRow], mission: MissionConfiguration
) -> dict[tuple[int, str], list[Task]]:
    """(exposure, detector) of each task -> tasks of the same detector that left something in it, in order of time.

    exposures : by their number;  mission : the mission database
    Error     : what is not rendered leaves nothing; of exposures that differ in their noise alone the first counts
    """
    by_detector: dict[tuple[Any, ...], list[Task]] = defaultdict(list)
    for task in tasks:
        row = exposures[task["exposure_id"]]
        channel = registry.CHANNELS.get(row.channel)
        if channel is not None and channel.remembers is not None:
            by_detector[row.camera, row.settings, task["detector"]].append(task)
    found = {}
    for (camera, *_), some in by_detector.items():
        window = mission.value(f"{camera}.persistence.window", "h") * _HOUR_S / _DAY_S
        some.sort(key=lambda task: (exposures[task["exposure_id"]].mjd, task["exposure_id"]))
        began = np.array([exposures[task["exposure_id"]].mjd for task in some])
        for task, now in zip(some, began.tolist(), strict=True):
            before = some[int(np.searchsorted(began, now - window)) : int(np.searchsorted(began, now))]
            first = [one for one in before if (exposures[one["exposure_id"]].realisation or 1) == 1]
            found[task["exposure_id"], task["detector"]] = first
    return found


def delay(exposure: ExposureRow, before: ExposureRow) -> float:
    """Seconds from the start of an exposure to that of a later one; BadInput where it is not later."""
    seconds = (exposure.mjd - before.mjd) * _DAY_S
    if not seconds > 0.0:
        raise BadInput(f"exposure {before.exposure_id} begins no earlier than exposure {exposure.exposure_id}")
    return seconds


def least_flux(exposure: ExposureRow, before: ExposureRow) -> float:
    """f_nu of the faintest source that is drawn again, microjansky; infinite where none shone."""
    if not registry.CHANNELS[before.channel].sees_sky(before.image_type):
        return float("inf")
    return _LEAST * _older(exposure, before) / (electron_rate(before) * before.exposure_time_s)


def _older(exposure: ExposureRow, before: ExposureRow) -> float:
    return delay(exposure, before) / _SECONDS


def remembered(aim: Aim, earlier: Sequence[Earlier], variant: Variant) -> Frame | None:
    """[ny, nx] electrons that earlier exposures leave in one; None = nothing.

    aim     : the exposure and detector;  earlier : of the same detector
    variant : mission, accuracy and the effects that are forced on or off
    """
    if aim.channel.remembers is None or not earlier:
        return None
    left = np.zeros((aim.detector.ny, aim.detector.nx))
    for before in earlier:
        scene = scene_of.of_aim(before.aim, variant)
        seconds = delay(aim.exposure, before.aim.exposure), aim.exposure.exposure_time_s
        charge = _charge(before, scene, _older(aim.exposure, before.aim.exposure))
        left += Traps.of(scene).left(charge, *seconds)
    return left


def _charge(before: Earlier, scene: Scene, older: float) -> Frame:
    """Expected electrons [ny, nx] of its light: sources that leave something, sky and lamp."""
    aim = before.aim
    frame = _sources(aim, before.rows, scene, older)
    for effect in aim.effects:
        if effect is aim.channel.remembers:
            break
        # What each pixel makes of the light is no part of it.
        if not effect.fixed and effect.applied(scene):
            frame = effect.apply(frame, *effect.parameters(scene), rng=np.random.default_rng(0))
    return frame


def _sources(aim: Aim, rows: Rows, scene: Scene, older: float) -> Frame:
    detector, rows = aim.detector, standard_stars.with_standards(rows, aim, scene.mission)
    column = f"f_nu_{aim.exposure.band}"
    pairs = ((rows.galaxies, rows.galaxy_fluxes), (rows.stars, rows.star_fluxes))
    galaxies, stars = (visible_sources.fluxes_of(*pair, column) * aim.electrons for pair in pairs)
    if not aim.sees_sky or not len(galaxies) + len(stars):
        return np.zeros((detector.ny, detector.nx))
    noise = _LEFT_OUT * older
    # One place and colour of the PSF: what is left is a part in a hundred of what it is left of.
    settings = replace(settings_for(scene.accuracy), positions=1, colours=1)
    psf = visible_sources.psf_of(aim, scene, settings)
    sources, sizes = visible_sources.sources_of(rows, (galaxies, stars), aim, psf, noise, settings)
    return stamps.draw(sources, sizes, psf, detector.nx, detector.ny)
