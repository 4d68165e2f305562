"""What earlier exposures of a detector left in it: each is drawn again from the catalogue, without noise.

No exposure needs the image of another, so that they are rendered in any order: what is left is a function of the
planned exposures and the catalogue alone.  Of an earlier exposure are drawn the stars and galaxies that leave
something, its sky and its lamp, through a grism as they were; of one that nothing renders its mean sky alone counts.
Error : cosmic rays, moving bodies and lensed arcs of earlier exposures are not drawn again.  A pixel that a hit gave
        2300 e- lacks 10 e- of what it leaves after 134 s.  Of a spectrum a source that is too faint to be drawn again
        counts as flat: a line that has more than `_LEAST` electrons of its own is missed with it

earlier_of        the tasks before a task;  remembers   whether there are any
window            how long before, days
is_drawn          whether an earlier exposure's sources count
brightest_column  of a source, part of its light;  least_flux   f_nu of the faintest source that is drawn again
remembered        what they left
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from truesky.randomness.rng import stream
from truesky.render.channels import registry
from truesky.render.channels.aim import Aim, electron_rate
from truesky.render.channels.image_types import shared_settings
from truesky.render.dispersing import draw as dispersing
from truesky.render.drawing import stamp_sizes, stamps
from truesky.render.drawing.settings import settings_for
from truesky.render.effects.charge import ramp
from truesky.render.effects.charge.persistence import PersistenceModel, variation_of_scene
from truesky.render.effects.scene import Frame, Scene
from truesky.render.exposure import scene_factory, sky_through_grism, visible_sources
from truesky.render.exposure.records import PreviousExposure, PreviousSky, Rows, Variant
from truesky.render.exposure.visible_spectra import visible_spectra
from truesky.render.psf.model import Psf
from truesky.render.sources import solar_system

_DAY_S = 86400.0
# Of a date, s: more than its rounding.
_TIME_TOLERANCE_S = 1e-3
# Images of which nothing of the sky is on a detector.
_STARLESS = ("bias", "dark", "flat", "charge_injection", "persistence")
# Electrons of the faintest source that is drawn again so many seconds later, and of a pixel's light that stamps leave
# out; more where more time has passed.  A star of so many leaves 0.8 e- in a pixel; of two exposures of the demo's sky
# before one, 1.2 e- are missed in a pixel at the most.
_MIN_ELECTRONS, _NEGLECTED_ELECTRONS, _REFERENCE_S = 400.0, 300.0, 134.0
# Of a point's light in an image, in its brightest column: a column of a spectrum that has as much leaves as much.
_COLUMN_FRACTION = 0.5
# Of the brightest column that counts, what stamps of spectra leave out in a row at their edge.
_EDGE_FRACTION = 0.1
# Electrons that light brings to some pixel at least, to be worth a look: ten leave 0.05.
_MIN_LIGHT = 10.0

# Name of the random numbers of what each pixel's traps have of their own.
_VARIATION_STREAM = "persistence_pixels"

Task = Mapping[str, Any]


def previous_tasks(
    tasks: Iterable[Task],
    exposures: Mapping[int, ExposureRow],
    mission_of: Callable[[str | None], MissionConfiguration],
) -> dict[tuple[int, str], list[Task]]:
    """(exposure, detector) of each task -> tasks of the same detector that left something in it, in order of time.

    exposures  : by their number;  mission_of : an exposure's settings -> its mission database
    Error      : of exposures that differ in their noise alone the first counts
    Errors     : BadInput where a detector is exposed before an exposure of it has ended
    """
    by_detector: dict[tuple[Any, ...], list[Task]] = defaultdict(list)
    cameras = {row.camera for row in exposures.values() if has_persistence(row)}
    for task in tasks:
        row = exposures[task["exposure_id"]]
        if row.camera in cameras:
            by_detector[row.camera, shared_settings(row.settings), task["detector"]].append(task)
    previous_of_task = {}
    for (camera, settings, detector), detector_tasks in by_detector.items():
        days = window_days(camera, mission_of(settings))
        detector_tasks.sort(key=lambda task: (exposures[task["exposure_id"]].mjd, task["exposure_id"]))
        _check_no_overlap([exposures[task["exposure_id"]] for task in detector_tasks], detector, mission_of)
        start_mjd = np.array([exposures[task["exposure_id"]].mjd for task in detector_tasks])
        for task, mjd in zip(detector_tasks, start_mjd.tolist(), strict=True):
            if not has_persistence(exposures[task["exposure_id"]]):
                continue
            window_start = int(np.searchsorted(start_mjd, mjd - days))
            in_window = detector_tasks[window_start : int(np.searchsorted(start_mjd, mjd))]
            first_realisations = [
                candidate for candidate in in_window if (exposures[candidate["exposure_id"]].realisation or 1) == 1
            ]
            previous_of_task[task["exposure_id"], task["detector"]] = first_realisations
    return previous_of_task


def _check_no_overlap(
    rows: Sequence[ExposureRow], detector: str, mission_of: Callable[[str | None], MissionConfiguration]
) -> None:
    """Refuse exposures of a detector, in order of time, of which one begins before another has ended.

    Such as begin at once are alternatives of one another.
    """
    for previous, current in pairwise(rows):
        channel, seconds = registry.CHANNELS.get(previous.channel), previous.exposure_time_s
        interval_s = (current.mjd - previous.mjd) * _DAY_S
        if channel is not None and channel.ramp_name and interval_s > 0.0:
            seconds = ramp.duration(channel.ramp_name, seconds, previous.camera, mission_of(previous.settings))
        if 0.0 < interval_s < seconds - _TIME_TOLERANCE_S:
            raise BadInput(
                f"exposures {previous.exposure_id} and {current.exposure_id} of detector {detector}: the second begins "
                f"{interval_s:.1f} s after the first, which takes {seconds:.1f} s"
            )


def has_persistence(exposure: ExposureRow) -> bool:
    """Whether a detector of the exposure has something left of those before."""
    channel = registry.CHANNELS.get(exposure.channel)
    return channel is not None and channel.persistence_effect is not None


def window_days(camera: str, mission: MissionConfiguration) -> float:
    """How long before an exposure others count, days."""
    return mission.value(f"{camera}.persistence.window", "d")


def is_drawn(previous: ExposureRow) -> bool:
    """Whether an earlier exposure is drawn again; else its mean sky counts."""
    return registry.find_effects_or_none(previous.channel, previous.image_type) is not None


def delay(exposure: ExposureRow, previous: ExposureRow) -> float:
    """Seconds from the start of an exposure to that of a later one; BadInput where it is not later."""
    seconds = (exposure.mjd - previous.mjd) * _DAY_S
    if not seconds > 0.0:
        raise BadInput(f"exposure {previous.exposure_id} begins no earlier than exposure {exposure.exposure_id}")
    return seconds


def brightest_column_fraction(aim: Aim, mission: MissionConfiguration) -> float:
    """Part of a point's light in its brightest column: of all orders' where a grism spreads it out, of flat f_nu.

    aim : the exposure and detector;  mission : the mission database
    """
    dispersion, band = aim.channel.dispersion, aim.band
    if dispersion is None or not aim.sees_sky:
        return _COLUMN_FRACTION
    detected, largest = band.response / band.wavelength, 0.0
    # An error of the wheel turns orders and leaves their length.
    for trace in dispersion.traces(aim.exposure, aim.detector, mission, 0):
        throughput = dispersion.throughput(aim.exposure, trace.order, band.wavelength, aim.detector, mission)
        middle = trace.polynomials((aim.detector.nx - 1) / 2, (aim.detector.ny - 1) / 2)
        pixels = float(np.hypot(*(part[1:].sum() for part in middle)))
        width = max(round((trace.last - trace.first) / max(pixels, 1e-6)), 1)
        light = np.cumsum(np.pad(detected * throughput, (width, width)))
        largest = max(largest, float((light[width:] - light[:-width]).max()) / float(detected.sum()))
    return largest


def min_flux(exposure: ExposureRow, previous: ExposureRow, column: float = _COLUMN_FRACTION) -> float:
    """f_nu of the faintest source that is drawn again, microjansky; infinite where none shone.

    exposure, before : the later and the earlier;  column : `brightest_column` of the earlier
    """
    if not registry.CHANNELS[previous.channel].sees_sky(previous.image_type):
        return float("inf")
    min_electrons = _MIN_ELECTRONS * _COLUMN_FRACTION / column
    return min_electrons * _age_factor(exposure, previous) / (electron_rate(previous) * previous.exposure_time_s)


def _age_factor(exposure: ExposureRow, previous: ExposureRow) -> float:
    return delay(exposure, previous) / _REFERENCE_S


def total_charge(
    aim: Aim, previous_exposures: Sequence[PreviousExposure | PreviousSky], variant: Variant, seed: int
) -> Frame | None:
    """[ny, nx] electrons that earlier exposures leave in one; None = nothing.

    aim     : the exposure and detector;  earlier : of the same detector
    variant : mission, accuracy and the effects that are forced on or off;  seed : of the request
    """
    if aim.channel.persistence_effect is None or not previous_exposures:
        return None
    scene = scene_factory.from_aim(aim, variant)
    model = PersistenceModel.from_scene(scene)
    variation = variation_of_scene(scene, stream(seed, aim.exposure.camera, aim.detector.name, _VARIATION_STREAM))
    total = np.zeros((aim.detector.ny, aim.detector.nx))
    for previous in previous_exposures:
        charge = _draw_charge(previous, variant, _age_factor(aim.exposure, previous.exposure), seed)
        times = delay(aim.exposure, previous.exposure), aim.exposure.exposure_time_s, previous.exposure.exposure_time_s
        total += model.released_charge(charge, *times, variation)
    return total


def _draw_charge(previous: PreviousExposure | PreviousSky, variant: Variant, age_factor: float, seed: int) -> Frame:
    """Expected electrons of its light: sources that leave something, sky and lamp [ny, nx]; or of a mean pixel [].

    Counted over its exposure time, as its signal is, of which the traps' parameters are told: what comes before a
    ramp's first group fills traps, too, and is not counted apart.
    """
    if isinstance(previous, PreviousSky):
        shines = previous.exposure.image_type not in _STARLESS
        return np.asarray(shines * previous.exposure.sky * previous.exposure.exposure_time_s)
    aim = previous.aim
    variant = variant if previous.mission is None else replace(variant, mission=previous.mission)
    scene = sky_through_grism.with_sky_change(scene_factory.from_aim(aim, variant), aim, seed)
    if aim.channel.dispersion is not None and aim.sees_sky:
        frame = _draw_spectra(aim, previous.rows, scene, age_factor, seed)
    else:
        frame = _draw_sources(aim, previous.rows, scene, age_factor)
    for effect in aim.effects:
        if effect is aim.channel.persistence_effect:
            break
        # What each pixel makes of the light is no part of it.
        if not effect.fixed and effect.is_applied(scene) and effect.contribution(scene) > _MIN_LIGHT:
            frame = effect.apply(frame, *effect.parameters(scene), rng=np.random.default_rng(0))
    return frame


def _draw_spectra(aim: Aim, rows: Rows, scene: Scene, age_factor: float, seed: int) -> Frame:
    """Orders of the sources that leave something; with the colours and lines that they have."""
    light = visible_spectra(aim, replace(rows, bodies=solar_system.empty_population), scene, seed)
    assert light.dispersed is not None
    assert light.psf is not None
    min_electrons = _MIN_ELECTRONS * _COLUMN_FRACTION * age_factor
    # With a noise of one these are electrons.
    settings = replace(light.dispersed.settings, faint=min_electrons, edge=_EDGE_FRACTION * min_electrons)
    dispersed = replace(light.dispersed, settings=settings)
    return dispersing.draw(light.sources, dispersed, light.psf, (aim.detector.ny, aim.detector.nx), 1.0)


def _draw_sources(aim: Aim, rows: Rows, scene: Scene, age_factor: float) -> Frame:
    detector, rows = aim.detector, visible_sources.rows_at_exposure(rows, aim, scene.mission)
    column = f"f_nu_{aim.exposure.band}"
    pairs = ((rows.galaxies, rows.galaxy_fluxes), (rows.stars, rows.star_fluxes))
    galaxies, stars = (visible_sources.row_fluxes(*pair, column) * aim.electrons_per_microjansky for pair in pairs)
    if not aim.sees_sky or not len(galaxies) + len(stars):
        return np.zeros((detector.ny, detector.nx))
    noise = _NEGLECTED_ELECTRONS * age_factor
    # Of one place of the PSF the brightest pixels would be wrong by 5 %, and what they leave by 3 e-; of one colour
    # by 2 %, and 1.5 e-.
    settings = replace(settings_for(scene.accuracy), colours=2)
    brightest = max(galaxies.max(initial=0.0), stars.max(initial=0.0))
    psf = _simplify_psf(visible_sources.exposure_psf(aim, scene, settings), brightest)
    sources, sizes = visible_sources.select_sources(rows, (galaxies, stars), aim, psf, noise, settings)
    neglected = stamp_sizes.neglected_flux(sources.electrons, noise, settings)
    return stamps.draw(sources, sizes, psf, detector.nx, detector.ny, neglected=neglected)


def _simplify_psf(psf: Psf, brightest: float) -> Psf:
    """Without the change across the detector of its change with colour; beyond the planes only what is noticed."""
    planes = psf.planes
    if planes is None:
        return psf
    achromatic = [number for number, (*_, colour) in enumerate(planes.powers) if not colour]
    planes = replace(
        planes, drift=planes.drift[achromatic], powers=tuple(planes.powers[number] for number in achromatic)
    )
    return replace(psf, planes=planes, edges=psf.edges if brightest * psf.rim[-1] > _MIN_LIGHT else None)
