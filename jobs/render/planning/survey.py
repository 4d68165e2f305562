"""From a request to its exposures, in the order they are taken.

exposures    pointings and observation blocks -> exposures, once for each variant of an exploration
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np

from jobs import rng
from jobs.render.camera import detectors
from jobs.render.camera.pointing import boresight_for
from jobs.render.channels import registry
from jobs.render.channels.image_types import SKY_TYPES
from jobs.render.planning import after_bright, calibration_frames, ground_surveys, reference_survey, variants
from jobs.render.planning.observing_sequence import sequence
from jobs.render.planning.planned_exposures import (
    Exposure,
    bands_of,
    check_macc,
    check_ramp,
    exposure_time,
    ramp_of,
    through_grism,
)
from jobs.render.sky.solar_aspect import check_aspect
from jobs.request import pointing_tables
from jobs.request.area import Area
from jobs.request.observations import Observation, Pointing
from jobs.request.schema import Request
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration

_DEEP = ("edf_north", "edf_south", "edf_fornax")
# Image types that are laid out as calibrations are.
_CALIBRATION = tuple(code for code in pointing_tables.IMAGE_TYPES if code not in ("science", "deep"))


def exposures(request: Request, mission: MissionConfiguration) -> list[tuple[Exposure, MissionConfiguration]]:
    """Every exposure of a request with the mission it is planned with; BadInput names the pointing or observation."""
    found = []
    for values in request.variants():
        shared = _Settled.of(values, request, mission)
        for exposure, own in _of_variant(request, values, shared):
            psf = exposure.psf or _own_psf(exposure, request)
            found.append((replace(exposure, settings=own.settings, psf=psf), own.mission))
    for band, _ in request.psfs:
        if band not in {exposure.band for exposure, _ in found}:
            raise BadInput(f"psf.{band}: no exposure is taken in this band")
    return found


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


def _of_variant(request: Request, values: Mapping[str, Any], shared: _Settled) -> Iterator[tuple[Exposure, _Settled]]:
    """Exposures, each with what it is planned with: of NISP, with its block's own ramp.

    Of both channels of NISP, of which one has this ramp.
    """
    for i, pointing in enumerate(request.pointings):
        one = _pointing(pointing, f"pointing[{i}]", request, shared.mission)
        yield from repeat((one, shared), pointing.realisations)
    # Of blocks that have no date NISP's begin when those before have ended, and what they left is gone.
    free = shared.mission.value("svm.launch", "d")
    for i, block in enumerate(request.observations):
        where, found = f"observation[{i}]", 0
        ramp = ramp_of(block)
        own = _Settled.of({**values, **variants.own(ramp)}, request, shared.mission) if ramp else shared
        kept: dict[tuple[bool, tuple[tuple[str, float, str], ...]], _Settled] = {(True, ()): own, (False, ()): shared}
        for exposure in _block(block, request, own.mission, where, free):
            found += 1
            if exposure.camera == "nisp" and (exposure.image_type in _CALIBRATION or _undated(block)):
                free = max(free, after_bright.forgotten(exposure, own.mission))
            of_nisp = exposure.camera == "nisp"
            which = of_nisp, exposure.parameters
            if which not in kept:
                changed = {key: (value, unit) for key, value, unit in exposure.parameters}
                more = {**ramp, **changed} if of_nisp else changed
                kept[which] = _Settled.of({**values, **variants.own(more)}, request, shared.mission)
            yield from repeat((exposure, kept[which]), block.realisations)
        if not found:
            raise BadInput(f"{where} asks for no exposure")


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


def _block(
    block: Observation, request: Request, mission: MissionConfiguration, where: str, free: float
) -> Iterator[Exposure]:
    """free : MJD from which NISP may observe."""
    area = block.area or request.area
    start = mission.value("svm.launch", "d") if block.mjd is None else block.mjd
    if _undated(block) and {"NISP-P", "NISP-S"} & {*block.channels}:
        start = free
    try:
        check_macc(block, mission)
        found = _exposures(block, area, request.seed, start, mission)
        for exposure in found:
            known_detectors(exposure.camera, exposure.detectors, mission, "detectors")
            check_ramp(exposure.channel, exposure.camera, exposure.exposure_time_s, mission)
            own = registry.CHANNELS[exposure.channel]
            if not own.on_ground and block.pointings and exposure.image_type in SKY_TYPES:
                check_aspect(exposure.ra, exposure.dec, exposure.mjd, mission, "pointings")
            yield exposure
    except BadInput as error:
        raise BadInput(f"{where}: {error}") from None


def _exposures(
    block: Observation, area: Area, seed: int, start: float, mission: MissionConfiguration
) -> Iterator[Exposure]:
    if block.pointings:
        yield from ground_surveys.read(Path(block.pointings), block, mission)
    elif block.image_type in _CALIBRATION:
        camera = ground_surveys.camera_of(block.survey, mission) if "EXT" in block.channels else ""
        yield from calibration_frames.exposures(block, camera, block.place or area.bounds()[:2], mission, seed, start)
    elif "EXT" in block.channels:
        yield from ground_surveys.exposures(block, area, mission, seed, start)
    else:
        for field in _fields(block, area, start, mission):
            yield from sequence(field, block, "own" if block.place else block.survey, mission, seed)


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
