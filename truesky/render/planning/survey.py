"""From a request to its exposures, in the order they are taken.

stretches    pointings and observation blocks -> stretches of exposures, once for each variant of an exploration
exposures    all of them
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, islice, repeat
from pathlib import Path
from typing import Any

import numpy as np

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from truesky.randomness import rng
from truesky.render.camera import detectors
from truesky.render.camera.pointing import boresight_for
from truesky.render.channels import registry
from truesky.render.channels.image_types import SKY_TYPES
from truesky.render.planning import calibration_frames, ground_surveys, persistence_darks, reference_survey, variants
from truesky.render.planning.observing_sequence import visit_exposures
from truesky.render.planning.planned_exposures import (
    Exposure,
    bands_of,
    check_macc,
    check_ramp,
    exposure_time,
    ramp_overrides,
    through_grism,
)
from truesky.render.sky.solar_aspect import check_aspect
from truesky.request import pointing_tables
from truesky.request.area import Area
from truesky.request.observations import Observation, Pointing
from truesky.request.schema import Request

_DEEP = ("edf_north", "edf_south", "edf_fornax")
# Image types that are laid out as calibrations are.
_CALIBRATION = tuple(code for code in pointing_tables.IMAGE_TYPES if code not in ("science", "deep"))
# Days: more than the rounding of a date, less than any exposure.
_DATE_TOLERANCE = 1e-7


ExposureWithMission = tuple[Exposure, MissionConfiguration]
# Whether it is of NISP; parameters of an exposure's own.
_SettingsKey = tuple[bool, tuple[tuple[str, float, str], ...]]


@dataclass(frozen=True, slots=True)
class ExposureBlock:
    """Exposures that follow one another: laid out one by one, or fields whose exposures are laid out when wanted.

    taken          : of pointings, calibrations, ground surveys; of fields those of the first, which stand for all
    fields, lay    : of Euclid's surveys, in the order of time, and what lays the exposures of one out
    times          : each is taken, one after another
    settled        : what exposures are planned with: whether of NISP, and parameters of their own
    """

    request: Request
    base_exposures: tuple[Exposure, ...]
    repetitions: int
    resolved_settings: Mapping[_SettingsKey, _ResolvedSettings]
    fields: tuple[reference_survey.Field, ...] = ()
    make_exposures: Callable[[reference_survey.Field], Iterable[Exposure]] | None = None

    @property
    def unit(self) -> int:
        """Exposures that are laid out at once: of a field."""
        return self.repetitions * (len(self.base_exposures) if self.make_exposures is not None else 1)

    def __len__(self) -> int:
        return self.unit * (len(self.fields) if self.make_exposures is not None else len(self.base_exposures))

    def exposures(self, first: int = 0, last: int | None = None) -> Iterator[ExposureWithMission]:
        """The exposures from the first to before the last, each with the mission that it is planned with."""
        last = len(self) if last is None else last
        start, end = first // self.unit, -(-last // self.unit)
        base = (
            self.base_exposures[start:end]
            if self.make_exposures is None
            else chain.from_iterable(map(self.make_exposures, self.fields[start:end]))
        )
        planned = (self._with_mission(exposure) for exposure in base)
        repeated = chain.from_iterable(repeat(planned_exposure, self.repetitions) for planned_exposure in planned)
        return islice(repeated, first - start * self.unit, last - start * self.unit)

    def settings_for(self, exposure: Exposure) -> _ResolvedSettings:
        """What one of the exposures is planned with."""
        return self.resolved_settings[exposure.camera == "nisp", exposure.parameters]

    def _with_mission(self, exposure: Exposure) -> ExposureWithMission:
        resolved = self.settings_for(exposure)
        psf = exposure.psf or _user_psf(exposure, self.request)
        if resolved.settings is None and psf is None:
            return exposure, resolved.mission
        return replace(exposure, settings=resolved.settings, psf=psf), resolved.mission

    def requested_detectors(self, first: int, last: int) -> list[tuple[str, ...]]:
        """The detectors that are wanted of each of these exposures, () = all."""
        detector_names = [exposure.detectors for exposure in self.base_exposures]
        return [detector_names[i // self.repetitions % len(detector_names)] for i in range(first, last)]

    def date_range(self, first: int, last: int) -> tuple[float, float]:
        """MJD before which none of these exposures begins, and after which none does."""
        start, end = first // self.unit, -(-last // self.unit)
        if self.make_exposures is None:
            start_mjds = [exposure.mjd for exposure in self.base_exposures[start:end]]
            return min(start_mjds), max(start_mjds)
        duration = max(exposure.mjd for exposure in self.base_exposures) - self.fields[0].mjd
        # A little more than the rounding of a date.
        return self.fields[start].mjd - _DATE_TOLERANCE, self.fields[end - 1].mjd + duration + _DATE_TOLERANCE

    def ranges_between_dates(self, start_mjd: float, end_mjd: float, end_number: int) -> list[tuple[int, int]]:
        """Runs of exposures, up to before a number, among which are all that begin between two dates."""
        if self.make_exposures is None:
            indices = [i for i, exposure in enumerate(self.base_exposures) if start_mjd <= exposure.mjd <= end_mjd]
            ranges = [(i * self.unit, (i + 1) * self.unit) for i in indices]
        else:
            field_mjds = np.array([field.mjd for field in self.fields])
            low, high = self.date_range(0, self.unit)
            limits = np.searchsorted(field_mjds, (start_mjd - (high - low), end_mjd + _DATE_TOLERANCE), "left")
            ranges = [(int(limits[0]) * self.unit, int(limits[1]) * self.unit)]
        return [(first, min(last, end_number)) for first, last in ranges if first < min(last, end_number)]


def exposure_blocks(request: Request, mission: MissionConfiguration) -> list[ExposureBlock]:
    """The exposures of a request, in the order they are numbered; BadInput names the pointing or observation."""
    blocks: list[ExposureBlock] = []
    for values in request.variants():
        blocks += _blocks_of_variant(request, values, _ResolvedSettings.from_values(values, request, mission))
    bands = {exposure.band for block in blocks for exposure in block.base_exposures}
    for band, _ in request.psfs:
        if band not in bands:
            raise BadInput(f"psf.{band}: no exposure is taken in this band")
    return blocks


def exposures(request: Request, mission: MissionConfiguration) -> list[ExposureWithMission]:
    """Every exposure of a request with the mission it is planned with; BadInput names the pointing or observation."""
    return [planned_exposure for block in exposure_blocks(request, mission) for planned_exposure in block.exposures()]


def _user_psf(exposure: Exposure, request: Request) -> str | None:
    """The request's file for the band; of several one is drawn for each exposure."""
    files = [file for band, file in request.psfs if band == exposure.band]
    if len(files) < 2:
        return files[0] if files else None
    where = (exposure.camera, exposure.band, *(value.hex() for value in (exposure.ra, exposure.dec, exposure.mjd)))
    return files[int(rng.stream(request.seed, "exposures.psf", *where).integers(len(files)))]


@dataclass(frozen=True, slots=True)
class _ResolvedSettings:
    """Values of a variant as the column `settings` has them, and the mission with them."""

    settings: str | None
    mission: MissionConfiguration

    @classmethod
    def from_values(
        cls, values: Mapping[str, Any], request: Request, mission: MissionConfiguration
    ) -> _ResolvedSettings:
        settings = json.dumps(values, sort_keys=True) if values else None
        return cls(settings, variants.variant(settings, mission, request.accuracy, {}).mission)


def _blocks_of_variant(
    request: Request, values: Mapping[str, Any], shared: _ResolvedSettings
) -> Iterator[ExposureBlock]:
    """What is taken, with what it is planned with: of NISP, with its block's own ramp.

    Of both channels of NISP, of which one has this ramp.
    """
    for i, pointing in enumerate(request.pointings):
        pointed_exposure = _exposure_of_pointing(pointing, f"pointing[{i}]", request, shared.mission)
        yield ExposureBlock(
            request, (pointed_exposure,), pointing.realisations, {(True, ()): shared, (False, ()): shared}
        )
    # Of blocks that have no date NISP's begin when those before have ended, and what they left is gone.
    nisp_free_mjd = shared.mission.value("svm.launch", "d")
    for i, block in enumerate(request.observations):
        where = f"observation[{i}]"
        ramp = ramp_overrides(block)
        block_settings = (
            _ResolvedSettings.from_values({**values, **variants.exposure_overrides(ramp)}, request, shared.mission)
            if ramp
            else shared
        )
        scheduled = _schedule_block(block, request, block_settings.mission, where, nisp_free_mjd)
        if not scheduled.base_exposures:
            raise BadInput(f"{where} asks for no exposure")
        settings_by_key: dict[_SettingsKey, _ResolvedSettings] = {(True, ()): block_settings, (False, ()): shared}
        for exposure in scheduled.base_exposures:
            of_nisp = exposure.camera == "nisp"
            if (of_nisp, exposure.parameters) not in settings_by_key:
                parameters = {key: (value, unit) for key, value, unit in exposure.parameters}
                overrides = {**ramp, **parameters} if of_nisp else parameters
                exposure_settings = _ResolvedSettings.from_values(
                    {**values, **variants.exposure_overrides(overrides)}, request, shared.mission
                )
                settings_by_key[of_nisp, exposure.parameters] = exposure_settings
        exposure_block = ExposureBlock(
            request,
            scheduled.base_exposures,
            block.realisations,
            settings_by_key,
            scheduled.fields,
            scheduled.make_exposures,
        )
        for exposure in scheduled.last_exposures():
            if exposure.camera == "nisp" and (exposure.image_type in _CALIBRATION or _is_undated(block)):
                nisp_free_mjd = max(
                    nisp_free_mjd, persistence_darks.persistence_end_mjd(exposure, block_settings.mission)
                )
        yield exposure_block


def _exposure_of_pointing(pointing: Pointing, where: str, request: Request, mission: MissionConfiguration) -> Exposure:
    try:
        bands = bands_of(pointing.channel, pointing.camera, mission)
    except BadInput as error:
        raise BadInput(f"{where}.camera: {error}") from None
    if pointing.band not in bands and pointing.band not in {name for name, _ in request.curves.passbands}:
        band_names = ", ".join(bands)
        raise BadInput(f"{where}.band: camera {pointing.camera} has no band {pointing.band!r} ({band_names})")
    check_detectors(pointing.camera, pointing.detectors, mission, f"{where}.detectors")
    ra, dec, angle = pointing.ra % 360.0, pointing.dec, pointing.position_angle
    if pointing.centre_on is not None:
        check_detectors(pointing.camera, (pointing.centre_on,), mission, f"{where}.centre_on")
        target = detectors.detector(pointing.camera, pointing.centre_on, mission)
        ra, dec, angle = boresight_for(target, ra, dec, angle)
    if not registry.CHANNELS[pointing.channel].on_ground:
        check_aspect(ra, dec, pointing.mjd, mission, where)
    seconds = pointing.exposure_time_s
    if seconds is None:
        seconds = exposure_time(pointing.channel, pointing.camera, pointing.band, mission)
    check_ramp(pointing.channel, pointing.camera, seconds, mission, where)
    exposure = Exposure(
        pointing.channel, pointing.camera, pointing.band, "science", ra, dec, angle, pointing.mjd, seconds,
        request.name, detectors=pointing.detectors,
    )  # fmt: skip
    return through_grism(exposure, pointing.grism_angle, mission, f"{where}.grism_angle")


def check_detectors(camera: str, names: tuple[str, ...], mission: MissionConfiguration, where: str) -> None:
    """Refuse detectors that a camera does not have.

    camera, names : of the camera, and of the detectors
    mission       : the mission database;  where : named in the refusal
    """
    available = {detector.name for detector in detectors.detectors(camera, mission)} if names else set()
    unknown = [name for name in names if name not in available]
    if unknown:
        raise BadInput(f"{where}: camera {camera} has no detector {unknown[0]!r}")


def _is_undated(block: Observation) -> bool:
    """Whether the survey says when a block is observed."""
    return block.mjd is None and not block.pointings


@dataclass(frozen=True, slots=True)
class _ScheduledBlock:
    """What a block asks for, as a Stretch has it."""

    base_exposures: tuple[Exposure, ...]
    fields: tuple[reference_survey.Field, ...] = ()
    make_exposures: Callable[[reference_survey.Field], Iterable[Exposure]] | None = None

    def last_exposures(self) -> Iterable[Exposure]:
        """Exposures among which is the last that each channel takes."""
        return self.base_exposures if self.make_exposures is None else self.make_exposures(self.fields[-1])


def _schedule_block(
    block: Observation, request: Request, mission: MissionConfiguration, where: str, nisp_free_mjd: float
) -> _ScheduledBlock:
    """free : MJD from which NISP may observe."""
    area = block.area or request.area
    start = mission.value("svm.launch", "d") if block.mjd is None else block.mjd
    if _is_undated(block) and {"NISP-P", "NISP-S"} & {*block.channels}:
        start = nisp_free_mjd
    try:
        check_macc(block, mission)
        scheduled = _schedule_exposures(block, area, request.seed, start, mission)
        # Of fields the first of either grism stands for all.
        first_visits = (
            ()
            if scheduled.make_exposures is None
            else (scheduled.make_exposures(field) for field in _first_visits(scheduled.fields))
        )
        for exposure in (*scheduled.base_exposures, *chain.from_iterable(first_visits)):
            check_detectors(exposure.camera, exposure.detectors, mission, "detectors")
            check_ramp(exposure.channel, exposure.camera, exposure.exposure_time_s, mission)
            channel = registry.CHANNELS[exposure.channel]
            if not channel.on_ground and block.pointings and exposure.image_type in SKY_TYPES:
                check_aspect(exposure.ra, exposure.dec, exposure.mjd, mission, "pointings")
        return scheduled
    except BadInput as error:
        raise BadInput(f"{where}: {error}") from None


def _first_visits(fields: Sequence[reference_survey.Field]) -> Iterator[reference_survey.Field]:
    """The first visit of an odd and the first of an even number."""
    for odd in (0, 1):
        yield from islice((field for field in fields if field.visit % 2 == odd), 1)


def _schedule_exposures(
    block: Observation, area: Area, seed: int, start: float, mission: MissionConfiguration
) -> _ScheduledBlock:
    if block.pointings:
        return _ScheduledBlock(tuple(ground_surveys.read(Path(block.pointings), block, mission)))
    if block.image_type in _CALIBRATION:
        camera = ground_surveys.camera_of(block.survey, mission) if "EXT" in block.channels else ""
        place = block.field_centre or area.bounding_circle()[:2]
        return _ScheduledBlock(tuple(calibration_frames.exposures(block, camera, place, mission, seed, start)))
    if "EXT" in block.channels:
        return _ScheduledBlock(tuple(ground_surveys.exposures(block, area, mission, seed, start)))
    fields = tuple(_fields(block, area, start, mission))
    name = "own" if block.field_centre else block.survey
    make_exposures = partial(visit_exposures, block=block, survey=name, mission=mission, seed=seed)
    return _ScheduledBlock(tuple(make_exposures(fields[0])) if fields else (), fields, make_exposures)


def _fields(
    block: Observation, area: Area, start: float, mission: MissionConfiguration
) -> list[reference_survey.Field]:
    if block.field_centre is not None:
        if block.mjd is not None:
            check_aspect(*block.field_centre, block.mjd, mission, "mjd")
        return reference_survey.user_field_visits(
            block.field_centre, mission, start, max(block.visits, 1), block.position_angle
        )
    if block.survey == "wide":
        return reference_survey.wide(area, mission, start, block.fields, max(block.visits, 1))
    visits = block.visits
    if block.survey in _DEEP:
        prefix = f"survey.{block.survey}"
        visits = visits or int(mission.value(f"{prefix}.visits"))
        area = block.area or deep_area(prefix, mission)
    return reference_survey.deep(area, mission, start, max(visits, 1), block.fields)


def deep_area(prefix: str, mission: MissionConfiguration) -> Area:
    """A deep field: its corners where they are published, else a circle of its area."""
    if f"{prefix}.corners" in mission:
        return Area(vertices=tuple((float(ra), float(dec)) for ra, dec in mission.numbers(f"{prefix}.corners")))
    cap = np.arccos(1.0 - mission.value(f"{prefix}.area", "rad2") / (2.0 * np.pi))
    ra, dec = (mission.value(f"{prefix}.{axis}", "deg") for axis in ("ra", "dec"))
    return Area(ra=ra, dec=dec, radius=float(np.degrees(cap)))
