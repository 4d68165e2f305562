"""Compute the persistence of a detector: the charge that earlier exposures release in this one.

Each earlier exposure is drawn again from the catalogue without noise. No exposure needs the image of another, so that
they can be rendered in any order: persistence depends only on the planned exposures and the catalogue. An earlier
exposure is drawn with its sky, its lamp, and the stars and galaxies that leave noticeable charge, dispersed if it had a
grism. An exposure of a channel that is not rendered contributes only its mean sky.

Cosmic rays, moving bodies and lensed arcs of earlier exposures are not drawn. For example, a pixel with a hit of 2300
electrons lacks 10 electrons of persistence after 134 s. In spectra, the limit for drawing a source assumes a flat
spectrum: fainter sources are omitted even if a line has more than `_MIN_ELECTRONS`.
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
# Tolerance of dates in seconds, more than their rounding.
_TIME_TOLERANCE_S = 1e-3
# Types of images without light of the sky.
_STARLESS = ("bias", "dark", "flat", "charge_injection", "persistence")
# Electrons of the faintest source that is drawn, electrons of a pixel that stamps may leave out, and the delay in
# seconds for which these limits hold; they grow with the delay. A star at the limit leaves 0.8 electrons in a pixel.
# For two earlier exposures of the demo's sky, at most 1.2 electrons of a pixel are missing.
_MIN_ELECTRONS, _NEGLECTED_ELECTRONS, _REFERENCE_S = 400.0, 300.0, 134.0
# Fraction of a point source's flux in its brightest column of an image. A column of a spectrum with the same flux
# leaves the same charge.
_COLUMN_FRACTION = 0.5
# Electrons that stamps of spectra may leave out in a row at their edge, relative to the lowest relevant column.
_EDGE_FRACTION = 0.1
# Electrons of its brightest pixel below which an effect is neglected: ten electrons leave 0.05.
_MIN_LIGHT = 10.0

# Name of the random stream for the variation of traps from pixel to pixel.
_VARIATION_STREAM = "persistence_pixels"

Task = Mapping[str, Any]


def previous_tasks(
    tasks: Iterable[Task],
    exposures: Mapping[int, ExposureRow],
    mission_of: Callable[[str | None], MissionConfiguration],
) -> dict[tuple[int, str], list[Task]]:
    """Find the earlier exposures that leave persistence in each task.

    Parameters
    ----------
    tasks : iterable of mapping
        Rows of the table `tasks`.
    exposures : mapping of int to ExposureRow
        Exposures by number.
    mission_of : callable
        Function that returns the mission database for the settings of an exposure.

    Returns
    -------
    dict of (int, str) to list of mapping
        For the exposure and detector of each task, earlier tasks of the same detector in order of time.

    Raises
    ------
    BadInput
        If an exposure of a detector begins before the previous one has ended.

    Notes
    -----
    If several exposures differ only in their noise, the first one counts.
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
    """Raise BadInput if an exposure of a detector (in order of time) begins before the previous one has ended.

    Exposures that begin at the same time are alternatives.
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
    """Return True if detectors of an exposure show persistence of earlier exposures."""
    channel = registry.CHANNELS.get(exposure.channel)
    return channel is not None and channel.persistence_effect is not None


def window_days(camera: str, mission: MissionConfiguration) -> float:
    """Return the time in days before an exposure in which other exposures leave persistence."""
    return mission.value(f"{camera}.persistence.window", "d")


def is_drawn(previous: ExposureRow) -> bool:
    """Return True if an earlier exposure can be drawn; otherwise only its mean sky counts."""
    return registry.find_effects_or_none(previous.channel, previous.image_type) is not None


def delay(exposure: ExposureRow, previous: ExposureRow) -> float:
    """Return the seconds from the start of `previous` to the start of `exposure`.

    Raises BadInput if `previous` does not begin first.
    """
    seconds = (exposure.mjd - previous.mjd) * _DAY_S
    if not seconds > 0.0:
        raise BadInput(f"exposure {previous.exposure_id} must begin before exposure {exposure.exposure_id}")
    return seconds


def brightest_column_fraction(aim: Aim, mission: MissionConfiguration) -> float:
    """Return the largest fraction of a point's light in one column, in any order of a grism, for flat f_nu."""
    dispersion, band = aim.channel.dispersion, aim.band
    if dispersion is None or not aim.sees_sky:
        return _COLUMN_FRACTION
    detected, largest = band.response / band.wavelength, 0.0
    # Use seed 0: a position error of the wheel rotates orders, but does not change their lengths.
    for trace in dispersion.traces(aim.exposure, aim.detector, mission, 0):
        throughput = dispersion.throughput(aim.exposure, trace.order, band.wavelength, aim.detector, mission)
        middle = trace.polynomials((aim.detector.nx - 1) / 2, (aim.detector.ny - 1) / 2)
        pixels = float(np.hypot(*(part[1:].sum() for part in middle)))
        width = max(round((trace.last - trace.first) / max(pixels, 1e-6)), 1)
        light = np.cumsum(np.pad(detected * throughput, (width, width)))
        largest = max(largest, float((light[width:] - light[:-width]).max()) / float(detected.sum()))
    return largest


def min_flux(exposure: ExposureRow, previous: ExposureRow, column: float = _COLUMN_FRACTION) -> float:
    """Flux of the faintest source of an earlier exposure that is drawn for its persistence.

    Parameters
    ----------
    exposure, previous : ExposureRow
        Later and earlier exposure.
    column : float, optional
        Result of `brightest_column_fraction` for the earlier exposure.

    Returns
    -------
    float
        f_nu in microjansky; infinite if no sources were visible.
    """
    if not registry.CHANNELS[previous.channel].sees_sky(previous.image_type):
        return float("inf")
    min_electrons = _MIN_ELECTRONS * _COLUMN_FRACTION / column
    return min_electrons * _age_factor(exposure, previous) / (electron_rate(previous) * previous.exposure_time_s)


def _age_factor(exposure: ExposureRow, previous: ExposureRow) -> float:
    """Return the delay relative to the reference delay of the limits."""
    return delay(exposure, previous) / _REFERENCE_S


def total_charge(
    aim: Aim, previous_exposures: Sequence[PreviousExposure | PreviousSky], variant: Variant, seed: int
) -> Frame | None:
    """Charge that earlier exposures release in one exposure.

    Parameters
    ----------
    aim : Aim
        Exposure and detector.
    previous_exposures : sequence of PreviousExposure or PreviousSky
        Earlier exposures of the same detector.
    variant : Variant
        Mission, accuracy and forced effects.
    seed : int
        Seed of the request.

    Returns
    -------
    float array, shape (ny, nx), or None
        Electrons. None if the channel has no persistence or there are no earlier exposures.
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
    """Return the expected electrons of an earlier exposure: per pixel, or one number for the mean sky.

    The electrons are counted over the exposure time of the signal, for which the parameters of traps are defined.
    Charge before the first group of a ramp also fills traps, but is not counted separately.
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
        # Fixed patterns of the detector are not part of the light.
        if not effect.fixed and effect.is_applied(scene) and effect.contribution(scene) > _MIN_LIGHT:
            frame = effect.apply(frame, *effect.parameters(scene), rng=np.random.default_rng(0))
    return frame


def _draw_spectra(aim: Aim, rows: Rows, scene: Scene, age_factor: float, seed: int) -> Frame:
    """Draw the spectra of sources that leave noticeable charge, with their colours and lines."""
    light = visible_spectra(aim, replace(rows, bodies=solar_system.empty_population), scene, seed)
    assert light.dispersed is not None
    assert light.psf is not None
    min_electrons = _MIN_ELECTRONS * _COLUMN_FRACTION * age_factor
    # The limits are in electrons because the noise passed to `draw` is 1.
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
    # With the PSF of one position the brightest pixels would have an error of 5 %, and their persistence of 3
    # electrons. With one colour the errors would be 2 % and 1.5 electrons.
    settings = replace(settings_for(scene.accuracy), colours=2)
    brightest = max(galaxies.max(initial=0.0), stars.max(initial=0.0))
    psf = _simplify_psf(visible_sources.exposure_psf(aim, scene, settings), brightest)
    sources, sizes = visible_sources.select_sources(rows, (galaxies, stars), aim, psf, noise, settings)
    neglected = stamp_sizes.neglected_flux(sources.electrons, noise, settings)
    return stamps.draw(sources, sizes, psf, detector.nx, detector.ny, neglected=neglected)


def _simplify_psf(psf: Psf, brightest: float) -> Psf:
    """Return the PSF with the same colour dependence at all positions, and without spikes if they are negligible."""
    planes = psf.planes
    if planes is None:
        return psf
    achromatic = [number for number, (*_, colour) in enumerate(planes.powers) if not colour]
    planes = replace(
        planes, drift=planes.drift[achromatic], powers=tuple(planes.powers[number] for number in achromatic)
    )
    return replace(psf, planes=planes, edges=psf.edges if brightest * psf.rim[-1] > _MIN_LIGHT else None)
