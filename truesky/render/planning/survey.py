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
from truesky.render.planning import after_bright, calibration_frames, ground_surveys, reference_survey, variants
from truesky.render.planning.observing_sequence import sequence
from truesky.render.planning.planned_exposures import (
    Exposure,
    bands_of,
    check_macc,
    check_ramp,
    exposure_time,
    ramp_of,
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
_NO_TIME = 1e-7


Taken = tuple[Exposure, MissionConfiguration]
# Whether it is of NISP; parameters of an exposure's own.
_Own = tuple[bool, tuple[tuple[str, float, str], ...]]


@dataclass(frozen=True, slots=True)
class Stretch:
    """Exposures that follow one another: laid out one by one, or fields whose exposures are laid out when wanted.

    taken          : of pointings, calibrations, ground surveys; of fields those of the first, which stand for all
    fields, lay    : of Euclid's surveys, in the order of time, and what lays the exposures of one out
    times          : each is taken, one after another
    settled        : what exposures are planned with: whether of NISP, and parameters of their own
    """

    request: Request
    taken: tuple[Exposure, ...]
    times: int
    settled: Mapping[_Own, _Settled]
    fields: tuple[reference_survey.Field, ...] = ()
    lay: Callable[[reference_survey.Field], Iterable[Exposure]] | None = None

    @property
    def unit(self) -> int:
        """Exposures that are laid out at once: of a field."""
        return self.times * (len(self.taken) if self.lay is not None else 1)

    def __len__(self) -> int:
        return self.unit * (len(self.fields) if self.lay is not None else len(self.taken))

    def exposures(self, first: int = 0, last: int | None = None) -> Iterator[Taken]:
        """The exposures from the first to before the last, each with the mission that it is planned with."""
        last = len(self) if last is None else last
        start, end = first // self.unit, -(-last // self.unit)
        laid = self.taken[start:end] if self.lay is None else chain.from_iterable(map(self.lay, self.fields[start:end]))
        each = (self._planned(exposure) for exposure in laid)
        repeated = chain.from_iterable(repeat(one, self.times) for one in each)
        return islice(repeated, first - start * self.unit, last - start * self.unit)

    def settled_of(self, exposure: Exposure) -> _Settled:
        """What one of the exposures is planned with."""
        return self.settled[exposure.camera == "nisp", exposure.parameters]

    def _planned(self, exposure: Exposure) -> Taken:
        own = self.settled_of(exposure)
        psf = exposure.psf or _own_psf(exposure, self.request)
        if own.settings is None and psf is None:
            return exposure, own.mission
        return replace(exposure, settings=own.settings, psf=psf), own.mission

    def wanted(self, first: int, last: int) -> list[tuple[str, ...]]:
        """The detectors that are wanted of each of these exposures, () = all."""
        of = [exposure.detectors for exposure in self.taken]
        return [of[i // self.times % len(of)] for i in range(first, last)]

    def times_of(self, first: int, last: int) -> tuple[float, float]:
        """MJD before which none of these exposures begins, and after which none does."""
        start, end = first // self.unit, -(-last // self.unit)
        if self.lay is None:
            began = [exposure.mjd for exposure in self.taken[start:end]]
            return min(began), max(began)
        after = max(exposure.mjd for exposure in self.taken) - self.fields[0].mjd
        # A little more than the rounding of a date.
        return self.fields[start].mjd - _NO_TIME, self.fields[end - 1].mjd + after + _NO_TIME

    def about(self, since: float, until: float, before: int) -> list[tuple[int, int]]:
        """Runs of exposures, up to before a number, among which are all that begin between two dates."""
        if self.lay is None:
            here = [i for i, exposure in enumerate(self.taken) if since <= exposure.mjd <= until]
            runs = [(i * self.unit, (i + 1) * self.unit) for i in here]
        else:
            began = np.array([field.mjd for field in self.fields])
            low, high = self.times_of(0, self.unit)
            near = np.searchsorted(began, (since - (high - low), until + _NO_TIME), "left")
            runs = [(int(near[0]) * self.unit, int(near[1]) * self.unit)]
        return [(first, min(last, before)) for first, last in runs if first < min(last, before)]


def stretches(request: Request, mission: MissionConfiguration) -> list[Stretch]:
    """The exposures of a request, in the order they are numbered; BadInput names the pointing or observation."""
    found: list[Stretch] = []
    for values in request.variants():
        found += _of_variant(request, values, _Settled.of(values, request, mission))
    taken = {exposure.band for stretch in found for exposure in stretch.taken}
    for band, _ in request.psfs:
        if band not in taken:
            raise BadInput(f"psf.{band}: no exposure is taken in this band")
    return found


def exposures(request: Request, mission: MissionConfiguration) -> list[Taken]:
    """Every exposure of a request with the mission it is planned with; BadInput names the pointing or observation."""
    return [one for stretch in stretches(request, mission) for one in stretch.exposures()]


def _own_psf(exposure: Exposure, request: Request) -> str | None:
    """The request's file for the band; of several one is drawn for each exposure."""
    files = [file for band, file in request.psfs if band == exposure.band]
    if len(files) < 2:
        return files[0] if files else None
    where = (exposure.camera, exposure.band, *(value.hex() for value in (exposure.ra, exposure.dec, exposure.mjd)))
    return files[int(rng.stream(request.seed, "exposures.psf", *where).integers(len(files)))]


@dataclass(frozen=True, slots=True)
class _Settled:
    """Values of a variant as the column `settings` has them, and the mission with them."""

    settings: str | None
    mission: MissionConfiguration

    @classmethod
    def of(cls, values: Mapping[str, Any], request: Request, mission: MissionConfiguration) -> _Settled:
        settings = json.dumps(values, sort_keys=True) if values else None
        return cls(settings, variants.variant(settings, mission, request.accuracy, {}).mission)


def _of_variant(request: Request, values: Mapping[str, Any], shared: _Settled) -> Iterator[Stretch]:
    """What is taken, with what it is planned with: of NISP, with its block's own ramp.

    Of both channels of NISP, of which one has this ramp.
    """
    for i, pointing in enumerate(request.pointings):
        one = _pointing(pointing, f"pointing[{i}]", request, shared.mission)
        yield Stretch(request, (one,), pointing.realisations, {(True, ()): shared, (False, ()): shared})
    # Of blocks that have no date NISP's begin when those before have ended, and what they left is gone.
    free = shared.mission.value("svm.launch", "d")
    for i, block in enumerate(request.observations):
        where = f"observation[{i}]"
        ramp = ramp_of(block)
        own = _Settled.of({**values, **variants.own(ramp)}, request, shared.mission) if ramp else shared
        laid = _block(block, request, own.mission, where, free)
        if not laid.taken:
            raise BadInput(f"{where} asks for no exposure")
        kept: dict[_Own, _Settled] = {(True, ()): own, (False, ()): shared}
        for exposure in laid.taken:
            of_nisp = exposure.camera == "nisp"
            if (of_nisp, exposure.parameters) not in kept:
                changed = {key: (value, unit) for key, value, unit in exposure.parameters}
                more = {**ramp, **changed} if of_nisp else changed
                settled = _Settled.of({**values, **variants.own(more)}, request, shared.mission)
                kept[of_nisp, exposure.parameters] = settled
        stretch = Stretch(request, laid.taken, block.realisations, kept, laid.fields, laid.lay)
        for exposure in laid.ends():
            if exposure.camera == "nisp" and (exposure.image_type in _CALIBRATION or _undated(block)):
                free = max(free, after_bright.forgotten(exposure, own.mission))
        yield stretch


def _pointing(pointing: Pointing, where: str, request: Request, mission: MissionConfiguration) -> Exposure:
    try:
        bands = bands_of(pointing.channel, pointing.camera, mission)
    except BadInput as error:
        raise BadInput(f"{where}.camera: {error}") from None
    if pointing.band not in bands and pointing.band not in {name for name, _ in request.curves.passbands}:
        known = ", ".join(bands)
        raise BadInput(f"{where}.band: camera {pointing.camera} has no band {pointing.band!r} ({known})")
    known_detectors(pointing.camera, pointing.detectors, mission, f"{where}.detectors")
    ra, dec, angle = pointing.ra % 360.0, pointing.dec, pointing.position_angle
    if pointing.centre_on is not None:
        known_detectors(pointing.camera, (pointing.centre_on,), mission, f"{where}.centre_on")
        target = detectors.detector(pointing.camera, pointing.centre_on, mission)
        ra, dec, angle = boresight_for(target, ra, dec, angle)
    if not registry.CHANNELS[pointing.channel].on_ground:
        check_aspect(ra, dec, pointing.mjd, mission, where)
    seconds = pointing.exposure_time_s
    if seconds is None:
        seconds = exposure_time(pointing.channel, pointing.camera, pointing.band, mission)
    check_ramp(pointing.channel, pointing.camera, seconds, mission, where)
    found = Exposure(
        pointing.channel, pointing.camera, pointing.band, "science", ra, dec, angle, pointing.mjd, seconds,
        request.name, detectors=pointing.detectors,
    )  # fmt: skip
    return through_grism(found, pointing.grism_angle, mission, f"{where}.grism_angle")


def known_detectors(camera: str, names: tuple[str, ...], mission: MissionConfiguration, where: str) -> None:
    """Refuse detectors that a camera does not have.

    camera, names : of the camera, and of the detectors
    mission       : the mission database;  where : named in the refusal
    """
    there = {detector.name for detector in detectors.detectors(camera, mission)} if names else set()
    unknown = [name for name in names if name not in there]
    if unknown:
        raise BadInput(f"{where}: camera {camera} has no detector {unknown[0]!r}")


def _undated(block: Observation) -> bool:
    """Whether the survey says when a block is observed."""
    return block.mjd is None and not block.pointings


@dataclass(frozen=True, slots=True)
class _Laid:
    """What a block asks for, as a Stretch has it."""

    taken: tuple[Exposure, ...]
    fields: tuple[reference_survey.Field, ...] = ()
    lay: Callable[[reference_survey.Field], Iterable[Exposure]] | None = None

    def ends(self) -> Iterable[Exposure]:
        """Exposures among which is the last that each channel takes."""
        return self.taken if self.lay is None else self.lay(self.fields[-1])


def _block(block: Observation, request: Request, mission: MissionConfiguration, where: str, free: float) -> _Laid:
    """free : MJD from which NISP may observe."""
    area = block.area or request.area
    start = mission.value("svm.launch", "d") if block.mjd is None else block.mjd
    if _undated(block) and {"NISP-P", "NISP-S"} & {*block.channels}:
        start = free
    try:
        check_macc(block, mission)
        laid = _exposures(block, area, request.seed, start, mission)
        # Of fields the first of either grism stands for all.
        seconds = () if laid.lay is None else (laid.lay(field) for field in _first_visits(laid.fields))
        for exposure in (*laid.taken, *chain.from_iterable(seconds)):
            known_detectors(exposure.camera, exposure.detectors, mission, "detectors")
            check_ramp(exposure.channel, exposure.camera, exposure.exposure_time_s, mission)
            own = registry.CHANNELS[exposure.channel]
            if not own.on_ground and block.pointings and exposure.image_type in SKY_TYPES:
                check_aspect(exposure.ra, exposure.dec, exposure.mjd, mission, "pointings")
        return laid
    except BadInput as error:
        raise BadInput(f"{where}: {error}") from None


def _first_visits(fields: Sequence[reference_survey.Field]) -> Iterator[reference_survey.Field]:
    """The first visit of an odd and the first of an even number."""
    for odd in (0, 1):
        yield from islice((field for field in fields if field.visit % 2 == odd), 1)


def _exposures(block: Observation, area: Area, seed: int, start: float, mission: MissionConfiguration) -> _Laid:
    if block.pointings:
        return _Laid(tuple(ground_surveys.read(Path(block.pointings), block, mission)))
    if block.image_type in _CALIBRATION:
        camera = ground_surveys.camera_of(block.survey, mission) if "EXT" in block.channels else ""
        place = block.place or area.bounds()[:2]
        return _Laid(tuple(calibration_frames.exposures(block, camera, place, mission, seed, start)))
    if "EXT" in block.channels:
        return _Laid(tuple(ground_surveys.exposures(block, area, mission, seed, start)))
    fields = tuple(_fields(block, area, start, mission))
    name = "own" if block.place else block.survey
    lay = partial(sequence, block=block, survey=name, mission=mission, seed=seed)
    return _Laid(tuple(lay(fields[0])) if fields else (), fields, lay)


def _fields(
    block: Observation, area: Area, start: float, mission: MissionConfiguration
) -> list[reference_survey.Field]:
    if block.place is not None:
        if block.mjd is not None:
            check_aspect(*block.place, block.mjd, mission, "mjd")
        return reference_survey.own(block.place, mission, start, max(block.visits, 1), block.position_angle)
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
