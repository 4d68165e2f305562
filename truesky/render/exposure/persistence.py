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
from truesky.render.channels.image_types import family
from truesky.render.dispersing import draw as dispersing
from truesky.render.drawing import stamp_sizes, stamps
from truesky.render.drawing.settings import settings_for
from truesky.render.effects.charge import ramp
from truesky.render.effects.charge.persistence import Traps, pixels_of
from truesky.render.effects.scene import Frame, Scene
from truesky.render.exposure import scene_of, spread_sky, visible_sources
from truesky.render.exposure.records import Earlier, EarlierSky, Rows, Variant
from truesky.render.exposure.visible_spectra import visible_spectra
from truesky.render.psf.model import Psf
from truesky.render.sources import solar_system

_DAY_S = 86400.0
# Of a date, s: more than its rounding.
_SAME_S = 1e-3
# Images of which nothing of the sky is on a detector.
_STARLESS = ("bias", "dark", "flat", "charge_injection", "persistence")
# Electrons of the faintest source that is drawn again so many seconds later, and of a pixel's light that stamps leave
# out; more where more time has passed.  A star of so many leaves 0.8 e- in a pixel; of two exposures of the demo's sky
# before one, 1.2 e- are missed in a pixel at the most.
_LEAST, _LEFT_OUT, _SECONDS = 400.0, 300.0, 134.0
# Of a point's light in an image, in its brightest column: a column of a spectrum that has as much leaves as much.
_COLUMN = 0.5
# Of the brightest column that counts, what stamps of spectra leave out in a row at their edge.
_EDGE = 0.1
# Electrons that light brings to some pixel at least, to be worth a look: ten leave 0.05.
_WORTH = 10.0

# Name of the random numbers of what each pixel's traps have of their own.
_PIXELS = "persistence_pixels"

Task = Mapping[str, Any]


def earlier_of(
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
    cameras = {row.camera for row in exposures.values() if remembers(row)}
    for task in tasks:
        row = exposures[task["exposure_id"]]
        if row.camera in cameras:
            by_detector[row.camera, family(row.settings), task["detector"]].append(task)
    found = {}
    for (camera, settings, detector), some in by_detector.items():
        days = window(camera, mission_of(settings))
        some.sort(key=lambda task: (exposures[task["exposure_id"]].mjd, task["exposure_id"]))
        _check_one_at_a_time([exposures[task["exposure_id"]] for task in some], detector, mission_of)
        began = np.array([exposures[task["exposure_id"]].mjd for task in some])
        for task, now in zip(some, began.tolist(), strict=True):
            if not remembers(exposures[task["exposure_id"]]):
                continue
            since = int(np.searchsorted(began, now - days))
            before = some[since : int(np.searchsorted(began, now))]
            first = [one for one in before if (exposures[one["exposure_id"]].realisation or 1) == 1]
            found[task["exposure_id"], task["detector"]] = first
    return found


def _check_one_at_a_time(
    rows: Sequence[ExposureRow], detector: str, mission_of: Callable[[str | None], MissionConfiguration]
) -> None:
    """Refuse exposures of a detector, in order of time, of which one begins before another has ended.

    Such as begin at once are alternatives of one another.
    """
    for before, now in pairwise(rows):
        channel, seconds = registry.CHANNELS.get(before.channel), before.exposure_time_s
        apart = (now.mjd - before.mjd) * _DAY_S
        if channel is not None and channel.ramp and apart > 0.0:
            seconds = ramp.elapsed(channel.ramp, seconds, before.camera, mission_of(before.settings))
        if 0.0 < apart < seconds - _SAME_S:
            raise BadInput(
                f"exposures {before.exposure_id} and {now.exposure_id} of detector {detector}: the second begins "
                f"{apart:.1f} s after the first, which takes {seconds:.1f} s"
            )


def remembers(exposure: ExposureRow) -> bool:
    """Whether a detector of the exposure has something left of those before."""
    channel = registry.CHANNELS.get(exposure.channel)
    return channel is not None and channel.remembers is not None


def window(camera: str, mission: MissionConfiguration) -> float:
    """How long before an exposure others count, days."""
    return mission.value(f"{camera}.persistence.window", "d")


def is_drawn(before: ExposureRow) -> bool:
    """Whether an earlier exposure is drawn again; else its mean sky counts."""
    return registry.effects_or_none(before.channel, before.image_type) is not None


def delay(exposure: ExposureRow, before: ExposureRow) -> float:
    """Seconds from the start of an exposure to that of a later one; BadInput where it is not later."""
    seconds = (exposure.mjd - before.mjd) * _DAY_S
    if not seconds > 0.0:
        raise BadInput(f"exposure {before.exposure_id} begins no earlier than exposure {exposure.exposure_id}")
    return seconds


def brightest_column(aim: Aim, mission: MissionConfiguration) -> float:
    """Part of a point's light in its brightest column: of all orders' where a grism spreads it out, of flat f_nu.

    aim : the exposure and detector;  mission : the mission database
    """
    dispersion, band = aim.channel.disperses, aim.band
    if dispersion is None or not aim.sees_sky:
        return _COLUMN
    detected, found = band.response / band.wavelength, 0.0
    # An error of the wheel turns orders and leaves their length.
    for trace in dispersion.traces(aim.exposure, aim.detector, mission, 0):
        throughput = dispersion.throughput(aim.exposure, trace.order, band.wavelength, aim.detector, mission)
        middle = trace.polynomials((aim.detector.nx - 1) / 2, (aim.detector.ny - 1) / 2)
        pixels = float(np.hypot(*(part[1:].sum() for part in middle)))
        wide = max(round((trace.last - trace.first) / max(pixels, 1e-6)), 1)
        light = np.cumsum(np.pad(detected * throughput, (wide, wide)))
        found = max(found, float((light[wide:] - light[:-wide]).max()) / float(detected.sum()))
    return found


def least_flux(exposure: ExposureRow, before: ExposureRow, column: float = _COLUMN) -> float:
    """f_nu of the faintest source that is drawn again, microjansky; infinite where none shone.

    exposure, before : the later and the earlier;  column : `brightest_column` of the earlier
    """
    if not registry.CHANNELS[before.channel].sees_sky(before.image_type):
        return float("inf")
    least = _LEAST * _COLUMN / column
    return least * _older(exposure, before) / (electron_rate(before) * before.exposure_time_s)


def _older(exposure: ExposureRow, before: ExposureRow) -> float:
    return delay(exposure, before) / _SECONDS


def remembered(aim: Aim, earlier: Sequence[Earlier | EarlierSky], variant: Variant, seed: int) -> Frame | None:
    """[ny, nx] electrons that earlier exposures leave in one; None = nothing.

    aim     : the exposure and detector;  earlier : of the same detector
    variant : mission, accuracy and the effects that are forced on or off;  seed : of the request
    """
    if aim.channel.remembers is None or not earlier:
        return None
    scene = scene_of.of_aim(aim, variant)
    traps = Traps.of(scene)
    own = pixels_of(scene, stream(seed, aim.exposure.camera, aim.detector.name, _PIXELS))
    left = np.zeros((aim.detector.ny, aim.detector.nx))
    for before in earlier:
        charge = _charge(before, variant, _older(aim.exposure, before.exposure), seed)
        times = delay(aim.exposure, before.exposure), aim.exposure.exposure_time_s, before.exposure.exposure_time_s
        left += traps.left(charge, *times, own)
    return left


def _charge(before: Earlier | EarlierSky, variant: Variant, older: float, seed: int) -> Frame:
    """Expected electrons of its light: sources that leave something, sky and lamp [ny, nx]; or of a mean pixel [].

    Counted over its exposure time, as its signal is, of which the traps' parameters are told: what comes before a
    ramp's first group fills traps, too, and is not counted apart.
    """
    if isinstance(before, EarlierSky):
        shines = before.exposure.image_type not in _STARLESS
        return np.asarray(shines * before.exposure.sky * before.exposure.exposure_time_s)
    aim = before.aim
    variant = variant if before.mission is None else replace(variant, mission=before.mission)
    scene = spread_sky.with_sky(scene_of.of_aim(aim, variant), aim, seed)
    if aim.channel.disperses is not None and aim.sees_sky:
        frame = _spectra(aim, before.rows, scene, older, seed)
    else:
        frame = _sources(aim, before.rows, scene, older)
    for effect in aim.effects:
        if effect is aim.channel.remembers:
            break
        # What each pixel makes of the light is no part of it.
        if not effect.fixed and effect.applied(scene) and effect.contribution(scene) > _WORTH:
            frame = effect.apply(frame, *effect.parameters(scene), rng=np.random.default_rng(0))
    return frame


def _spectra(aim: Aim, rows: Rows, scene: Scene, older: float, seed: int) -> Frame:
    """Orders of the sources that leave something; with the colours and lines that they have."""
    light = visible_spectra(aim, replace(rows, bodies=solar_system.nobody), scene, seed)
    assert light.dispersed is not None
    assert light.psf is not None
    least = _LEAST * _COLUMN * older
    # With a noise of one these are electrons.
    settings = replace(light.dispersed.settings, faint=least, edge=_EDGE * least)
    dispersed = replace(light.dispersed, settings=settings)
    return dispersing.draw(light.sources, dispersed, light.psf, (aim.detector.ny, aim.detector.nx), 1.0)


def _sources(aim: Aim, rows: Rows, scene: Scene, older: float) -> Frame:
    detector, rows = aim.detector, visible_sources.rows_of(rows, aim, scene.mission)
    column = f"f_nu_{aim.exposure.band}"
    pairs = ((rows.galaxies, rows.galaxy_fluxes), (rows.stars, rows.star_fluxes))
    galaxies, stars = (visible_sources.fluxes_of(*pair, column) * aim.electrons for pair in pairs)
    if not aim.sees_sky or not len(galaxies) + len(stars):
        return np.zeros((detector.ny, detector.nx))
    noise = _LEFT_OUT * older
    # Of one place of the PSF the brightest pixels would be wrong by 5 %, and what they leave by 3 e-; of one colour
    # by 2 %, and 1.5 e-.
    settings = replace(settings_for(scene.accuracy), colours=2)
    brightest = max(galaxies.max(initial=0.0), stars.max(initial=0.0))
    psf = _needed(visible_sources.psf_of(aim, scene, settings), brightest)
    sources, sizes = visible_sources.sources_of(rows, (galaxies, stars), aim, psf, noise, settings)
    neglected = stamp_sizes.neglected_flux(sources.electrons, noise, settings)
    return stamps.draw(sources, sizes, psf, detector.nx, detector.ny, neglected=neglected)


def _needed(psf: Psf, brightest: float) -> Psf:
    """Without the change across the detector of its change with colour; beyond the planes only what is noticed."""
    planes = psf.planes
    if planes is None:
        return psf
    same = [number for number, (*_, colour) in enumerate(planes.powers) if not colour]
    planes = replace(planes, drift=planes.drift[same], powers=tuple(planes.powers[number] for number in same))
    return replace(psf, planes=planes, edges=psf.edges if brightest * psf.rim[-1] > _WORTH else None)
