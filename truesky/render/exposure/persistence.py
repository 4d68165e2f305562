"""Compute the persistence of a detector: charge that was trapped in earlier exposures and is released in a later one.

The charge map of an earlier exposure, its expected electrons, is drawn again from the catalogue. No exposure needs the
image of another, so exposures can be simulated in any order: persistence depends only on the planned exposures and the
catalogue. The charge map depends only on the earlier exposure and the detector. The same map is therefore used for all
later exposures. It contains sky and lamp, and the stars, galaxies, lensed arcs and moving bodies that leave noticeable
charge, dispersed if the exposure had a grism. An exposure that cannot be simulated contributes only its mean sky.

Cosmic rays of earlier exposures are not drawn. For example, a pixel that was hit by a cosmic ray of 2300 electrons
lacks 10 electrons of persistence after 134 s. Sources are selected as if their spectra were flat. A source may
therefore be omitted although one of its emission lines leaves noticeable charge.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from lake_schema.arrays import Float32
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from truesky.randomness.rng import stream
from truesky.render.channels import registry
from truesky.render.channels.aim import Aim, electron_rate
from truesky.render.channels.image_types import shared_settings
from truesky.render.dispersing import draw as dispersing
from truesky.render.drawing import stamps
from truesky.render.drawing.settings import settings_for
from truesky.render.effects.charge import ramp
from truesky.render.effects.charge.persistence import PersistenceModel, variation_of_scene
from truesky.render.effects.scene import Frame, Scene
from truesky.render.exposure import scene_factory, sky_through_grism, visible_sources
from truesky.render.exposure.records import PreviousExposure, PreviousSky, Rows, Variant
from truesky.render.exposure.visible_sources import visible_light
from truesky.render.exposure.visible_spectra import visible_spectra
from truesky.render.psf.model import Psf

# Seconds per day.
_DAY_S = 86400.0
# Longest time in s by which an exposure of a detector may begin before the end of the previous one. Rounding of dates
# causes shorter overlaps; a longer overlap is an error.
_TIME_TOLERANCE_S = 1e-3
# Image types without light of the sky. An earlier exposure of these types that cannot be simulated causes no
# persistence.
_STARLESS = ("bias", "dark", "flat", "charge_injection", "persistence")
# Smallest number of electrons with which a point source in an earlier exposure is drawn, per second of exposure time.
# The limit is proportional to the exposure time, because the next exposure cannot begin sooner than that. A NISP-P
# image after 15 exposures (four dithers of NISP-S and three bands) lacks at most 0.84 electrons in a pixel, compared
# with limits that are twenty times lower.
_MIN_RATE = 2.3
# Electrons per pixel and second of exposure time that replace the noise of a pixel when sources of an earlier exposure
# are drawn: light that is small compared with them is neglected.
_NEGLECTED_RATE = 1.7
# Assumed fraction of a point source's flux in its brightest column in a direct image. A spectrum whose brightest column
# has the same electrons is assumed to leave the same persistence.
_COLUMN_FRACTION = 0.5
# Light of a spectrum in a row at the edge of its stamp (image in which it is drawn) that may be neglected, as a
# fraction of the electrons that the faintest drawn spectrum has in a column.
_EDGE_FRACTION = 0.1
# A detector effect in an earlier exposure is neglected if it changes no pixel by more than this number of electrons.
# Ten electrons leave 0.05 electrons of persistence.
_MIN_LIGHT = 10.0

# Name under which random numbers are drawn for the density of traps, which varies from pixel to pixel.
_VARIATION_STREAM = "persistence_pixels"

Task = Mapping[str, Any]


def previous_tasks(
    tasks: Iterable[Task],
    exposures: Mapping[int, ExposureRow],
    mission_of: Callable[[str | None], MissionConfiguration],
) -> dict[tuple[int, str], list[Task]]:
    """Find the earlier exposures that leave persistence in each detector of each exposure.

    Parameters
    ----------
    tasks : iterable of mapping
        Rows of the table `tasks`; a task is one detector of one exposure.
    exposures : mapping of int to ExposureRow
        Rows of the table `exposures` by `exposure_id`; it must contain the exposures of all tasks.
    mission_of : callable
        Function (column `settings` of an exposure: JSON of changed parameters, or None) -> mission database with them.

    Returns
    -------
    dict of (int, str) to list of mapping
        By exposure_id and detector: the tasks of the same detector whose exposures begin earlier, by at most
        `window_days`, in order of time. If a request explores parameters (simulates the same sky with several values),
        only exposures with the same values are included. Detectors without persistence have no entry.

    Raises
    ------
    BadInput
        If an exposure of a detector begins before the previous one has ended.

    Notes
    -----
    If several exposures differ only in their noise (realisations), only the first is included.
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
    """Raise BadInput if one of the exposures `rows` of a detector begins before the previous one has ended.

    `rows` must be in order of time. Exposures that begin at the same time are allowed: they are alternative versions of
    one exposure.
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
    """Return True if persistence of earlier exposures is simulated in the detectors of an exposure."""
    channel = registry.CHANNELS.get(exposure.channel)
    return channel is not None and channel.persistence_effect is not None


def window_days(camera: str, mission: MissionConfiguration) -> float:
    """Return how long before an exposure other exposures may begin and still leave persistence in it, days."""
    return mission.value(f"{camera}.persistence.window", "d")


def is_drawn(previous: ExposureRow) -> bool:
    """Return True if an earlier exposure can be simulated; if not, only its mean sky causes persistence."""
    return registry.find_effects_or_none(previous.channel, previous.image_type) is not None


def delay(exposure: ExposureRow, previous: ExposureRow) -> float:
    """Return the seconds from the start of an earlier exposure `previous` to the start of `exposure`.

    Raises BadInput if `previous` does not begin before `exposure`.
    """
    seconds = (exposure.mjd - previous.mjd) * _DAY_S
    if not seconds > 0.0:
        raise BadInput(f"exposure {previous.exposure_id} must begin before exposure {exposure.exposure_id}")
    return seconds


def brightest_column_fraction(aim: Aim, mission: MissionConfiguration) -> float:
    """Return the largest fraction of a point source's light in one column of the image.

    For a direct image, and for an image without light of the sky, it is assumed to be 0.5. For a grism it is the
    maximum over all columns of all spectral orders, for a source with constant f_nu, relative to the light that the
    passband detects.
    """
    dispersion, band = aim.channel.dispersion, aim.band
    if dispersion is None or not aim.sees_sky:
        return _COLUMN_FRACTION
    detected, largest = band.response / band.wavelength, 0.0
    # The seed determines the position error of the grism wheel. It rotates the spectral orders, but does not change
    # their lengths, so any seed may be used here.
    for trace in dispersion.traces(aim.exposure, aim.detector, mission, 0):
        throughput = dispersion.throughput(aim.exposure, trace.order, band.wavelength, aim.detector, mission)
        middle = trace.polynomials((aim.detector.nx - 1) / 2, (aim.detector.ny - 1) / 2)
        pixels = float(np.hypot(*(part[1:].sum() for part in middle)))
        width = max(round((trace.last - trace.first) / max(pixels, 1e-6)), 1)
        light = np.cumsum(np.pad(detected * throughput, (width, width)))
        largest = max(largest, float((light[width:] - light[:-width]).max()) / float(detected.sum()))
    return largest


def min_flux(previous: ExposureRow, column: float = _COLUMN_FRACTION) -> float:
    """Return the flux of the faintest source of an earlier exposure that is drawn in its charge map.

    Parameters
    ----------
    previous : ExposureRow
        Earlier exposure.
    column : float, optional
        Result of `brightest_column_fraction` for the earlier exposure. The default is that of a direct image.

    Returns
    -------
    float
        f_nu in microjansky; infinite if the earlier exposure has no light of the sky.
    """
    if not registry.CHANNELS[previous.channel].sees_sky(previous.image_type):
        return float("inf")
    return _MIN_RATE * _COLUMN_FRACTION / column / electron_rate(previous)


def total_charge(
    aim: Aim, previous_exposures: Sequence[PreviousExposure | PreviousSky], variant: Variant, seed: int
) -> Frame | None:
    """Return the charge that traps filled in earlier exposures release during one exposure.

    Parameters
    ----------
    aim : Aim
        Exposure and detector.
    previous_exposures : sequence of PreviousExposure or PreviousSky
        Earlier exposures of the same detector.
    variant : Variant
        Mission database, accuracy, and the effects that the request switches on or off.
    seed : int
        Seed of the request, from which the variation of traps from pixel to pixel is drawn.

    Returns
    -------
    float array, shape (ny, nx), or None
        Electrons per pixel. None if the channel has no persistence or there are no earlier exposures.
    """
    if aim.channel.persistence_effect is None or not previous_exposures:
        return None
    scene = scene_factory.from_aim(aim, variant)
    model = PersistenceModel.from_scene(scene)
    variation = variation_of_scene(scene, stream(seed, aim.exposure.camera, aim.detector.name, _VARIATION_STREAM))
    total = np.zeros((aim.detector.ny, aim.detector.nx))
    for previous in previous_exposures:
        charge = _mean_charge(previous.exposure) if isinstance(previous, PreviousSky) else previous.charge()
        times = delay(aim.exposure, previous.exposure), aim.exposure.exposure_time_s, previous.exposure.exposure_time_s
        total += model.released_charge(charge, *times, variation)
    return total


def _mean_charge(exposure: ExposureRow) -> Frame:
    """Return the electrons per pixel, as one number, of an exposure of which only the mean sky is known."""
    return np.asarray((exposure.image_type not in _STARLESS) * exposure.sky * exposure.exposure_time_s)


def draw_charge_map(aim: Aim, rows: Rows, variant: Variant, seed: int, fraction: float = 1.0) -> Float32:
    """Draw the expected electrons of an exposure from which the persistence in later exposures is computed.

    Parameters
    ----------
    aim : Aim
        Exposure and detector.
    rows : Rows
        Catalogue rows of the sources that leave noticeable charge: at least those above `min_flux`.
    variant : Variant
        Mission database, accuracy, and forced effects of this exposure.
    seed : int
        Seed of the request, from which moving bodies and the position errors of wheels are drawn.
    fraction : float, optional
        Factor by which the limits of neglected light are multiplied. It is 1 except in tests, which compare the map
        with a more complete one.

    Returns
    -------
    float32 array, shape (ny, nx)
        Electrons collected in the exposure time.

    Notes
    -----
    Persistence that is computed from these maps lacks less than 1 electron in a pixel after 15 exposures, compared with
    maps whose limits of neglected light are twenty times lower.

    In a ramp, the exposure time begins with the first group of reads. The parameters of traps refer to the electrons
    collected since then. As an approximation, charge collected before this group is not counted, although it also fills
    traps.
    """
    scene = sky_through_grism.with_sky_change(scene_factory.from_aim(aim, variant), aim, seed)
    if aim.channel.dispersion is not None and aim.sees_sky:
        frame = _draw_spectra(aim, rows, scene, seed, fraction)
    else:
        frame, scene = _draw_sources(aim, rows, scene, seed, fraction)
    for effect in aim.effects:
        if effect is aim.channel.persistence_effect:
            break
        # Apply those effects that come before persistence in the channel's list of effects and that add or change
        # light, such as the sky. Fixed patterns of the detector are omitted, because they do not consist of light.
        if not effect.fixed and effect.is_applied(scene) and effect.contribution(scene) > _MIN_LIGHT:
            frame = effect.apply(frame, *effect.parameters(scene), rng=np.random.default_rng(0))
    return frame.astype(np.float32)


def _draw_spectra(aim: Aim, rows: Rows, scene: Scene, seed: int, fraction: float) -> Frame:
    """Return the expected electrons [ny, nx] of the slitless spectra of sources that leave noticeable persistence.

    The limits of neglected light are multiplied by `fraction`.
    """
    light = visible_spectra(aim, rows, scene, seed)
    assert light.dispersed is not None
    assert light.psf is not None
    min_electrons = fraction * _MIN_RATE * _COLUMN_FRACTION * aim.exposure.exposure_time_s
    # The limits `faint` and `edge` are fractions of the pixel noise. Here they are in electrons, because 1 electron is
    # passed to `draw` as the noise.
    settings = replace(light.dispersed.settings, faint=min_electrons, edge=_EDGE_FRACTION * min_electrons)
    dispersed = replace(light.dispersed, settings=settings)
    return dispersing.draw(light.sources, dispersed, light.psf, (aim.detector.ny, aim.detector.nx), 1.0)


def _draw_sources(aim: Aim, rows: Rows, scene: Scene, seed: int, fraction: float) -> tuple[Frame, Scene]:
    """Return the expected electrons [ny, nx] of sources in a direct image, and the scene with its bright sources.

    The limits of neglected light are multiplied by `fraction`.
    """
    detector = aim.detector
    if not aim.sees_sky:
        return np.zeros((detector.ny, detector.nx)), scene
    # Two wavelengths in the passband at which the PSF is computed are enough. With one wavelength, the brightest pixels
    # would have an error of 2 %, and their persistence one of 1.5 electrons. The number of positions on the detector at
    # which the PSF is computed is not reduced: with one position, the errors would be 5 % and 3 electrons.
    settings = replace(settings_for(scene.accuracy), colours=2)
    psf = visible_sources.exposure_psf(aim, scene, settings)
    light = visible_light(aim, rows, scene, seed, psf, fraction * _NEGLECTED_RATE * aim.exposure.exposure_time_s)
    assert light.psf is not None
    psf = _simplify_psf(light.psf, float(light.sources.electrons.max(initial=0.0)))
    frame = stamps.draw(light.sources, light.sizes, psf, detector.nx, detector.ny, neglected=light.neglected)
    return frame, light.scene


def _simplify_psf(psf: Psf, brightest: float) -> Psf:
    """Return a simpler PSF, with which an earlier exposure is drawn faster.

    Its dependence on colour is the same at all positions on the detector. Light beyond the border of the PSF images,
    such as spikes, is omitted if it is negligible for a source with `brightest` electrons.
    """
    planes = psf.planes
    if planes is None:
        return psf
    achromatic = [number for number, (*_, colour) in enumerate(planes.powers) if not colour]
    planes = replace(
        planes, drift=planes.drift[achromatic], powers=tuple(planes.powers[number] for number in achromatic)
    )
    return replace(psf, planes=planes, edges=psf.edges if brightest * psf.rim[-1] > _MIN_LIGHT else None)
