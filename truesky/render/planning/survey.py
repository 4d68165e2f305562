"""Plan all exposures of a request, in the order in which they are numbered.

Each pointing and each observation of the request becomes a block of consecutive exposures. If the request explores
parameters (simulates the same sky with several values), each combination of values has its own blocks.
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

from lake_schema.errors import BadInput, Mistakes, bad_input
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.texts import spelling
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
from truesky.render.sky.solar_aspect import check_aspect, check_launch
from truesky.request.area import Area
from truesky.request.exposures import pointing_tables
from truesky.request.exposures.observations import Observation
from truesky.request.exposures.pointings import Pointing
from truesky.request.instruments import check_band, check_detectors
from truesky.request.schema import Request

# Keys of an observation with which a message about it may begin.
_KEY_STARTS = ("mjd:", "detectors:", "pointings:", "pointings[", "lamps:", "bands:")
# Names of the Euclid Deep Fields.
_DEEP = ("edf_north", "edf_south", "edf_fornax")
# Image types of calibrations, whose exposures the module `calibration_frames` plans.
_CALIBRATION = tuple(code for code in pointing_tables.IMAGE_TYPES if code not in ("science", "deep"))
# Tolerance in days when dates (MJD) of Euclid fields and their exposures are compared: larger than rounding errors, and
# much shorter than a visit of a field.
_DATE_TOLERANCE = 1e-7


# A planned exposure, and the mission parameters with which it is simulated.
ExposureWithMission = tuple[Exposure, MissionConfiguration]
# Pair that selects the settings of an exposure: True if its camera is NISP, and the mission parameters (name, value,
# unit) that are replaced for this exposure alone.
_SettingsKey = tuple[bool, tuple[tuple[str, float, str], ...]]


@dataclass(frozen=True, slots=True)
class ExposureBlock:
    """Consecutive exposures of a pointing or an observation of the request; its length is their number.

    The exposures are stored one by one. For fields of a Euclid survey, only the fields are stored, and their exposures
    are made when they are needed.

    Attributes
    ----------
    request : Request
        The user's request.
    base_exposures : tuple of Exposure
        All exposures without their repetitions. For Euclid fields, only the exposures of the first field, which
        represents the others.
    repetitions : int
        Number of times that each exposure is taken in succession.
    resolved_settings : mapping
        Changed parameters and the resulting mission parameters of each kind of exposure. The key is a pair: True if
        the camera is NISP, and the parameters that are changed for this exposure alone.
    fields : tuple of Field
        Fields of a Euclid survey in order of time; () for other blocks.
    make_exposures : callable, optional
        Returns the exposures of a field; None if the block has no fields.
    """

    request: Request
    base_exposures: tuple[Exposure, ...]
    repetitions: int
    resolved_settings: Mapping[_SettingsKey, _ResolvedSettings]
    fields: tuple[reference_survey.Field, ...] = ()
    make_exposures: Callable[[reference_survey.Field], Iterable[Exposure]] | None = None

    @property
    def unit(self) -> int:
        """Number of exposures that are planned together: all exposures of a field, or all repetitions of one."""
        return self.repetitions * (len(self.base_exposures) if self.make_exposures is not None else 1)

    def __len__(self) -> int:
        return self.unit * (len(self.fields) if self.make_exposures is not None else len(self.base_exposures))

    def exposures(self, first: int = 0, last: int | None = None) -> Iterator[ExposureWithMission]:
        """Generate the exposures with indices `first` to `last - 1`, each with its mission parameters.

        Indices count from 0, with repetitions. `last` None means up to the end of the block.
        """
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
        """Return the parameters that the request changes for an exposure, and the resulting mission parameters."""
        return self.resolved_settings[exposure.camera == "nisp", exposure.parameters]

    def _with_mission(self, exposure: Exposure) -> ExposureWithMission:
        resolved = self.settings_for(exposure)
        psf = exposure.psf or _user_psf(exposure, self.request)
        if resolved.settings is None and psf is None:
            return exposure, resolved.mission
        return replace(exposure, settings=resolved.settings, psf=psf), resolved.mission

    def requested_detectors(self, first: int, last: int) -> list[tuple[str, ...]]:
        """Return for each exposure with index `first` to `last - 1` the names of its requested detectors; () is all."""
        detector_names = [exposure.detectors for exposure in self.base_exposures]
        return [detector_names[i // self.repetitions % len(detector_names)] for i in range(first, last)]

    def date_range(self, first: int, last: int) -> tuple[float, float]:
        """Return an earliest and a latest MJD between which the exposures `first` to `last - 1` of the block begin.

        The range must not be empty. For Euclid fields the limits may be wider than the true dates.
        """
        start, end = first // self.unit, -(-last // self.unit)
        if self.make_exposures is None:
            start_mjds = [exposure.mjd for exposure in self.base_exposures[start:end]]
            return min(start_mjds), max(start_mjds)
        duration = max(exposure.mjd for exposure in self.base_exposures) - self.fields[0].mjd
        # Widen the range a little, because the dates of fields and of exposures are rounded differently.
        return self.fields[start].mjd - _DATE_TOLERANCE, self.fields[end - 1].mjd + duration + _DATE_TOLERANCE

    def ranges_between_dates(self, start_mjd: float, end_mjd: float, end_number: int) -> list[tuple[int, int]]:
        """Find the exposures of the block that begin between two dates.

        Parameters
        ----------
        start_mjd, end_mjd : float
            First and last MJD, both included.
        end_number : int
            Only exposures with indices below this number are considered.

        Returns
        -------
        list of (int, int)
            Ranges (first index, last index + 1); [] if no exposure begins between the dates. For fields of a Euclid
            survey, a range may include some exposures outside the dates.
        """
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
    """Return the blocks of exposures of a request, in the order in which their exposures are numbered.

    Raises BadInput if an exposure cannot be taken, for example because the Sun is too close or the camera lacks the
    band; there is one line for each pointing or observation with a mistake. Also if the request has a PSF for a band
    without exposures.
    """
    blocks: list[ExposureBlock] = []
    with Mistakes() as mistakes:
        for values in request.variants():
            settings = _ResolvedSettings.from_values(values, request, mission)
            blocks += _blocks_of_variant(request, values, settings, mistakes)
    with Mistakes() as mistakes:
        bands = {exposure.band for block in blocks for exposure in block.base_exposures}
        for band in dict.fromkeys(band for band, _ in request.psfs):
            if band not in bands:
                problem = f"psf.{band}: no exposure is taken in a band of this name"
                mistakes.add(BadInput(f"{problem}: {spelling.choices(band, sorted(bands))}"))
    return blocks


def exposures(request: Request, mission: MissionConfiguration) -> list[ExposureWithMission]:
    """Return all exposures of a request, each with its mission parameters.

    Raises BadInput if an exposure cannot be taken, like `exposure_blocks`.
    """
    return [planned_exposure for block in exposure_blocks(request, mission) for planned_exposure in block.exposures()]


def _user_psf(exposure: Exposure, request: Request) -> str | None:
    """Return the PSF file that the request gives for the band of an exposure, or None without such a file.

    If there are several files, one is drawn at random for each position and date.
    """
    files = [file for band, file in request.psfs if band == exposure.band]
    if len(files) < 2:
        return files[0] if files else None
    where = (exposure.camera, exposure.band, *(value.hex() for value in (exposure.ra, exposure.dec, exposure.mjd)))
    return files[int(rng.stream(request.seed, "exposures.psf", *where).integers(len(files)))]


@dataclass(frozen=True, slots=True)
class _ResolvedSettings:
    """Parameters with which an exposure is simulated.

    `settings` is a JSON table of the changed parameters, for the column `settings` of the table `exposures`; None
    without changes. `mission` has all mission parameters after these changes.
    """

    settings: str | None
    mission: MissionConfiguration

    @classmethod
    def from_values(
        cls, values: Mapping[str, Any], request: Request, mission: MissionConfiguration
    ) -> _ResolvedSettings:
        settings = json.dumps(values, sort_keys=True) if values else None
        return cls(settings, variants.variant(settings, mission, request.accuracy, {}).mission)


def _blocks_of_variant(
    request: Request, values: Mapping[str, Any], shared: _ResolvedSettings, mistakes: Mistakes
) -> Iterator[ExposureBlock]:
    """Generate the blocks of exposures (one per pointing and observation) for one combination of explored parameters.

    `values` has the values of the combination, by name of the parameter. `shared` has the same combination as JSON, and
    the mission parameters that result from it. A pointing or an observation that cannot be taken has no block; its
    mistakes are added to `mistakes`.
    """
    for i, pointing in enumerate(request.pointings):
        exposure = mistakes.read(_exposure_of_pointing, pointing, f"pointing[{i}]", request, shared.mission)
        if exposure is not None:
            settings: dict[_SettingsKey, _ResolvedSettings] = {(True, ()): shared, (False, ()): shared}
            yield ExposureBlock(request, (exposure,), pointing.realisations, settings)
    # Undated observations with NISP begin when the NISP exposures of earlier calibrations and undated observations have
    # ended and their persistence has faded. Other dated observations are not considered.
    nisp_free_mjd = shared.mission.value("svm.launch", "d")
    for i in range(len(request.observations)):
        block_and_mjd = mistakes.read(_block_of_observation, i, request, values, shared, nisp_free_mjd)
        if block_and_mjd is not None:
            exposure_block, nisp_free_mjd = block_and_mjd
            yield exposure_block


def _block_of_observation(
    number: int, request: Request, values: Mapping[str, Any], shared: _ResolvedSettings, nisp_free_mjd: float
) -> tuple[ExposureBlock, float]:
    """Return the block of exposures of an observation, and the MJD from which the next undated one may use NISP.

    `number` is the index of the observation in the request, and `nisp_free_mjd` the MJD from which it may use NISP.
    `values` and `shared` are arguments of `_blocks_of_variant`. If an observation gives its own up-the-ramp readout of
    NISP, or an exposure its own parameters, these replace the shared ones. Raises BadInput if an exposure cannot be
    taken; the message names the observation.
    """
    block, where = request.observations[number], f"observation[{number}]"
    ramp = ramp_overrides(block)
    block_settings = (
        _ResolvedSettings.from_values({**values, **variants.exposure_overrides(ramp)}, request, shared.mission)
        if ramp
        else shared
    )
    scheduled = _schedule_block(block, request, block_settings.mission, where, nisp_free_mjd)
    if not scheduled.base_exposures:
        raise BadInput(f"{where} has no exposures")
    if _is_own_field(block):
        scheduled = scheduled.with_field(1 + sum(_is_own_field(other) for other in request.observations[:number]))
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
            nisp_free_mjd = max(nisp_free_mjd, persistence_darks.persistence_end_mjd(exposure, block_settings.mission))
    return exposure_block, nisp_free_mjd


def _exposure_of_pointing(pointing: Pointing, where: str, request: Request, mission: MissionConfiguration) -> Exposure:
    try:
        bands = bands_of(pointing.channel, pointing.camera, mission)
    except BadInput as error:
        raise error.with_prefix(f"{where}.camera") from None
    if pointing.band not in {name for name, _ in request.curves.passbands}:
        check_band(pointing.band, bands, f"camera {pointing.camera}", f"{where}.band")
    check_detectors((pointing.camera,), pointing.detectors, mission, f"{where}.detectors")
    ra, dec, angle = pointing.ra % 360.0, pointing.dec, pointing.position_angle
    if pointing.centre_on is not None:
        check_detectors((pointing.camera,), (pointing.centre_on,), mission, f"{where}.centre_on")
        target = detectors.detector(pointing.camera, pointing.centre_on, mission)
        ra, dec, angle = boresight_for(target, ra, dec, angle)
    mjd = pointing.mjd
    if mjd is None:
        try:
            instrument = (pointing.channel, pointing.camera)
            mjd = ground_surveys.first_date(instrument, pointing.band, (ra, dec), mission)
        except BadInput as error:
            raise error.with_prefix(where) from None
    elif not registry.CHANNELS[pointing.channel].on_ground:
        check_aspect(ra, dec, mjd, mission, f"{where}.mjd")
    seconds = pointing.exposure_time_s
    if seconds is None:
        seconds = exposure_time(pointing.channel, pointing.camera, pointing.band, mission)
    check_ramp(pointing.channel, pointing.camera, seconds, mission, f"{where}.exposure_time_s")
    exposure = Exposure(
        pointing.channel, pointing.camera, pointing.band, "science", ra, dec, angle, mjd, seconds,
        request.name, detectors=pointing.detectors, clouds=pointing.clouds,
    )  # fmt: skip
    return through_grism(exposure, pointing.grism_angle, mission, f"{where}.grism_angle")


def _is_undated(block: Observation) -> bool:
    """Return True if an observation has neither a date nor a table of pointings, so that the planner sets its date."""
    return block.mjd is None and not block.pointings


@dataclass(frozen=True, slots=True)
class _ScheduledBlock:
    """Exposures of an observation, before the changes of mission parameters for each exposure have been computed.

    `fields` are the Euclid fields of the observation in order of time, () if it has no such fields. `base_exposures`
    are the exposures of the first field, or all exposures. `make_exposures` returns the exposures of a field; None
    without fields.
    """

    base_exposures: tuple[Exposure, ...]
    fields: tuple[reference_survey.Field, ...] = ()
    make_exposures: Callable[[reference_survey.Field], Iterable[Exposure]] | None = None

    def with_field(self, number: int) -> _ScheduledBlock:
        """Return the same observation with another number of its field, which does not change the positions."""
        if self.make_exposures is None:
            return self
        base = tuple(replace(exposure, field=number) for exposure in self.base_exposures)
        return replace(
            self, base_exposures=base, make_exposures=partial(_exposures_of_field, self.make_exposures, number)
        )

    def last_exposures(self) -> Iterable[Exposure]:
        """Return exposures of the observation that include the last one of each channel.

        They are the exposures of the last field, or all exposures if the observation has no fields.
        """
        return self.base_exposures if self.make_exposures is None else self.make_exposures(self.fields[-1])


def _is_own_field(block: Observation) -> bool:
    """Return True for an observation of Euclid's sequence of exposures at a position that the user gives."""
    is_frame = bool(block.pointings) or block.image_type in _CALIBRATION or "EXT" in block.channels
    return block.field_centre is not None and not is_frame


def _exposures_of_field(
    make_exposures: Callable[[reference_survey.Field], Iterable[Exposure]], number: int, field: reference_survey.Field
) -> Iterator[Exposure]:
    """Generate the exposures of a visit, with another number of the field."""
    for exposure in make_exposures(field):
        yield replace(exposure, field=number)


def _schedule_block(
    block: Observation, request: Request, mission: MissionConfiguration, where: str, nisp_free_mjd: float
) -> _ScheduledBlock:
    """Plan the exposures of an observation and check detectors, ramps and Sun constraints.

    An undated observation with NISP begins at MJD `nisp_free_mjd`, any other at its date, or after the launch and after
    first light of the camera. Raises BadInput with `where` (the observation in the request) if an exposure cannot be
    taken.
    """
    area = block.area or request.area
    start = block.mjd
    if start is None:
        camera = ground_surveys.camera_of(block.survey, mission) if "EXT" in block.channels else "vis"
        start = ground_surveys.earliest_date(camera, mission)
    if _is_undated(block) and {"NISP-P", "NISP-S"} & {*block.channels}:
        start = nisp_free_mjd
    try:
        if block.mjd is not None and block.field_centre is None and "EXT" not in block.channels:
            check_launch(block.mjd, mission, "mjd")
        check_macc(block, mission)
        scheduled = _schedule_exposures(block, area, request.seed, start, mission)
        # Check only the first visits with an even and an odd number: visits of Euclid fields differ only in the grism.
        first_visits = (
            ()
            if scheduled.make_exposures is None
            else (scheduled.make_exposures(field) for field in _first_visits(scheduled.fields))
        )
        for exposure in (*scheduled.base_exposures, *chain.from_iterable(first_visits)):
            check_detectors((exposure.camera,), exposure.detectors, mission, "detectors")
            check_ramp(exposure.channel, exposure.camera, exposure.exposure_time_s, mission)
            channel = registry.CHANNELS[exposure.channel]
            if not channel.on_ground and block.pointings:
                check_launch(exposure.mjd, mission, "pointings")
                if exposure.image_type in SKY_TYPES:
                    check_aspect(exposure.ra, exposure.dec, exposure.mjd, mission, "pointings")
        return scheduled
    except BadInput as error:
        # A message that begins with a key of the observation continues its path.
        paths = (f"{where}{'.' if message.startswith(_KEY_STARTS) else ': '}{message}" for message in error.messages)
        raise bad_input(paths) from None


def _first_visits(fields: Sequence[reference_survey.Field]) -> Iterator[reference_survey.Field]:
    """Yield the first visit with an even number and the first with an odd number, if there are any.

    The two represent all visits, because the blue grism can only be used in even visits.
    """
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
    """Return the area of a Euclid Deep Field on the sky.

    `prefix` is the beginning of its parameter names, such as "survey.edf_north". The area is the polygon of the
    published corners, or a circle with the published area if the mission database has no corners.
    """
    if f"{prefix}.corners" in mission:
        return Area(vertices=tuple((float(ra), float(dec)) for ra, dec in mission.numbers(f"{prefix}.corners")))
    cap = np.arccos(1.0 - mission.value(f"{prefix}.area", "rad2") / (2.0 * np.pi))
    ra, dec = (mission.value(f"{prefix}.{axis}", "deg") for axis in ("ra", "dec"))
    return Area(ra=ra, dec=dec, radius=float(np.degrees(cap)))
