"""One exposure as the planner lays it out, before it is a row of the table `exposures`.

Exposure       what, where and when
through_grism  with the grism whose spectra run at an angle
unturned       through a grism as it is without a tilt
table          exposures -> rows, with the sky, zero point and seeing of each
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa

from lake_schema import units
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.parameter import SPACE_CAMERAS
from lake_schema.tables.exposures import EXPOSURES, ExposureRow
from truesky.fluxes import passbands
from truesky.fluxes.passbands import Passband
from truesky.randomness import rng
from truesky.render.camera import detectors, grism_wheel, traces
from truesky.render.camera.detectors import Detector
from truesky.render.channels import image_types, registry
from truesky.render.effects.charge import ramp
from truesky.render.psf import seeing as ground_psf
from truesky.render.sky import night_sky, observatory
from truesky.render.sky.diffuse_light import SkyBand, sky_rate
from truesky.render.sky.night_sky import Night
from truesky.request.observations import Observation

# Grisms by the passband that they are used in.
GRISMS: Mapping[str, tuple[str, ...]] = {"nisp_red": ("RGS000", "RGS180"), "nisp_blue": ("BGS000",)}
_DARK_TYPES = ("bias", "dark", "charge_injection", "trap_pumping", "persistence")
# Columns that are counted here.
_COMPUTED_COLUMNS = ("exposure_id", "realisation", "airmass", "zenith")


@dataclass(frozen=True, slots=True)
class Exposure:
    """What, where and when.

    ra, dec, position_angle : deg, boresight and the focal plane's y axis, north through east
    detectors               : names, () = all of the camera
    sky, seeing, zero_point : electrons a second and pixel, arcsec, mag; None = the mission's
    parameters              : (key, value, unit) of the mission database that it is taken with instead of the request's
    """

    channel: str
    camera: str
    band: str
    image_type: str
    ra: float
    dec: float
    position_angle: float
    mjd: float
    exposure_time_s: float
    survey: str
    field: int | None = None
    visit: int | None = None
    dither: int | None = None
    grism: str | None = None
    grism_angle: float | None = None
    lamp: int | None = None
    target: str | None = None
    psf: str | None = None
    detectors: tuple[str, ...] = ()
    sky: float | None = None
    seeing: float | None = None
    zero_point: float | None = None
    settings: str | None = None
    parameters: tuple[tuple[str, float, str], ...] = ()


def bands_of(channel: str, camera: str, mission: MissionConfiguration) -> tuple[str, ...]:
    """Passbands that a camera has; BadInput where the channel has no such camera."""
    bands = registry.CHANNELS[channel].bands(camera, mission)
    if not bands:
        raise BadInput(f"channel {channel} has no camera {camera!r}")
    return bands


def through_grism(exposure: Exposure, angle: float | None, mission: MissionConfiguration, where: str = "") -> Exposure:
    """An exposure with the grism of its band whose spectra run nearest to an angle; as it is without a grism.

    angle : in the focal plane, deg, None = as the grism's own;  mission : the mission database
    where : named in the refusal
    Errors : BadInput for an angle without a grism, or one that no grism of the band is turned to
    """
    grisms = GRISMS.get(exposure.band, ())
    if not grisms:
        if angle is not None:
            raise BadInput(f"{where}: no grism of {exposure.camera} is in the beam in {exposure.band}")
        return exposure
    angle, section = angle or 0.0, image_types.section(exposure.camera)
    tilts = [abs(grism_wheel.tilt(grism, angle, section, mission)) for grism in grisms]
    nearest = int(np.argmin(tilts))
    if tilts[nearest] > grism_wheel.MAX_TILT:
        names = ", ".join(grisms)
        raise BadInput(f"{where} = {angle:g} deg turns {names} by more than {grism_wheel.MAX_TILT:g} deg")
    return replace(exposure, grism=grisms[nearest], grism_angle=angle)


def exposure_time(channel: str, camera: str, band: str, mission: MissionConfiguration) -> float:
    """Effective exposure time of a nominal exposure, s: of a ramp, from its first to its last group.

    channel, camera, band : names;  mission : the mission database
    """
    if camera == "nisp":
        kind = f"nisp.macc.{_ramp_name(channel)}"
        groups, reads, drops = (mission.value(f"{kind}.{part}") for part in ("groups", "reads", "drops"))
        return (groups - 1) * (reads + drops) * mission.value("nisp.frame_time", "s")
    key = f"{image_types.section(camera)}.{band}.exposure_time"
    return mission.value(key if key in mission else f"{image_types.section(camera)}.exposure_time", "s")


def elapsed_time(exposure: Exposure, mission: MissionConfiguration) -> float:
    """Seconds from the start of an exposure until its detectors may be exposed again: of a ramp, to its last read."""
    if exposure.camera != "nisp":
        return exposure.exposure_time_s
    return ramp.duration(_ramp_name(exposure.channel), exposure.exposure_time_s, exposure.camera, mission)


def check_ramp(channel: str, camera: str, seconds: float, mission: MissionConfiguration, where: str = "") -> None:
    """Refuse an exposure time that the camera cannot be read up a ramp in.

    channel, camera : names;  seconds : exposure time
    mission : the mission database;  where : named in the refusal
    """
    if camera == "nisp":
        try:
            ramp.find_mode(_ramp_name(channel), seconds, camera, mission)
        except BadInput as error:
            raise BadInput(f"{where}: {error}" if where else str(error)) from None


def check_macc(block: Observation, mission: MissionConfiguration) -> None:
    """Refuse an observation that asks for a ramp, and for an exposure time that this ramp does not take.

    block : of the request;  mission : with the block's ramp
    """
    if not block.macc or block.exposure_time_s is None:
        return
    ramp_seconds = exposure_time(channel_of_macc(block), "nisp", "", mission)
    if abs(block.exposure_time_s / ramp_seconds - 1.0) > ramp.FRAME_TOLERANCE:
        raise BadInput(
            f"macc = {[*block.macc]} takes {ramp_seconds:.4g} s, not exposure_time_s = {block.exposure_time_s:g}"
        )


def channel_of_macc(block: Observation) -> str:
    """Of a block of both channels of NISP its ramp is the photometer's."""
    return "NISP-P" if "NISP-P" in block.channels else "NISP-S"


def ramp_overrides(block: Observation) -> dict[str, tuple[float, str]]:
    """What a block's ramp changes of the mission: key -> (value, unit)."""
    key = f"nisp.macc.{_ramp_name(channel_of_macc(block))}"
    return {f"{key}.{part}": (n, "") for part, n in zip(("groups", "reads", "drops"), block.macc, strict=False)}


def _ramp_name(channel: str) -> str:
    return "spectroscopic" if channel == "NISP-S" else "photometric"


def table(
    exposures: Sequence[Exposure],
    missions: Sequence[MissionConfiguration],
    user_passbands: Mapping[str, Passband] | None = None,
    seed: int = 0,
    first: int = 1,
    previous: Iterable[Exposure] = (),
) -> pa.Table:
    """Rows of the table `exposures`, numbered in their order.

    missions : the configuration of each;  own : passbands by name besides the embedded ones
    seed     : of the request: of ground cameras the seeing is drawn
    first    : number of the first
    before   : earlier exposures, of which some may differ from these in their noise alone
    """
    if not exposures:
        return EXPOSURES.empty()
    bands: dict[tuple[int, str, str, str], _Band] = {}
    rows, occurrences = [], Counter(map(_realisation_key, previous))
    for number, (exposure, mission) in enumerate(zip(exposures, missions, strict=True), start=first):
        key = (id(mission), exposure.channel, exposure.camera, exposure.band)
        if key not in bands:
            bands[key] = _Band.from_exposure(exposure, mission, (user_passbands or {}).get(exposure.band))
        row = _row(number, exposure, bands[key], mission, seed)
        identity = _realisation_key(exposure)
        occurrences[identity] += 1
        rows.append({**row, "realisation": occurrences[identity]})
    return EXPOSURES.build({name: _column(name, [row[name] for row in rows]) for name in EXPOSURES.names})


def _realisation_key(e: Exposure) -> tuple[Any, ...]:
    """What two exposures have in common whose random numbers would be the same, of one request of an exploration."""
    angle = _wrap_angle(e.position_angle)
    return e.settings, e.camera, e.band, e.ra % 360.0, e.dec, angle, e.mjd, e.grism, e.grism_angle


def _wrap_angle(angle: float) -> float:
    return (angle + 180.0) % 360.0 - 180.0


@dataclass(frozen=True, slots=True)
class _Band:
    """What all exposures of a channel and camera in a band have in common."""

    zero_point: float
    sky: SkyBand
    seeing: float = 0.0
    scatter: float = 0.0
    night: Night | None = None
    detector: Detector | None = None
    curve: Passband | None = None

    @classmethod
    def from_exposure(cls, exposure: Exposure, mission: MissionConfiguration, curve: Passband | None) -> _Band:
        camera, band = exposure.camera, exposure.band
        prefix = image_types.section(camera)
        first = detectors.detectors(camera, mission)[0]
        sky = registry.CHANNELS[exposure.channel].sky(first, band, mission, curve)
        zero_point = zero_point_of(prefix, band, mission, curve)
        if camera in SPACE_CAMERAS:
            return cls(zero_point, sky)
        seeing = mission.value(f"{prefix}.{band}.seeing", "arcsec")
        curve = curve or passbands.load(band)
        night = Night.from_detector(first, band, (zero_point, sky.constant), mission, curve)
        return cls(zero_point, sky, seeing, mission.value(f"{prefix}.seeing_scatter", "dex"), night, first, curve)


def _column(name: str, values: list[Any]) -> Any:
    if EXPOSURES.column(name).type == "string" or not EXPOSURES.column(name).nullable:
        return values
    return np.ma.masked_array([0 if v is None else v for v in values], [v is None for v in values])


def _row(number: int, e: Exposure, band: _Band, mission: MissionConfiguration, seed: int) -> dict[str, Any]:
    sky, night, extinction_mag = e.sky, band.night, 0.0
    airmass: float | None = None
    zenith: float | None = None
    seeing = _seeing(e, band, seed) if e.seeing is None else e.seeing
    if night is not None and band.detector is not None and band.curve is not None:
        if e.psf is None:
            ground_psf.check(seeing, band.detector, band.curve, mission)
        airmass, zenith = observatory.airmass_and_zenith(e.ra, e.dec, e.mjd, night.site)
        extinction_mag = night_sky.extra_extinction(night, airmass)
    channel = registry.CHANNELS[e.channel]
    if e.image_type in _DARK_TYPES or (channel.on_ground and not channel.sees_sky(e.image_type)):
        sky = 0.0
    elif sky is None and night is not None:
        sky = night_sky.sky_rate(night, e.ra, e.dec, e.mjd, mission)
    elif sky is None:
        sky = sky_rate(band.sky, e.ra, e.dec, e.mjd, mission)
    return {
        **{name: getattr(e, name) for name in EXPOSURES.names if name not in _COMPUTED_COLUMNS},
        "exposure_id": number,
        "ra": e.ra % 360.0,
        "position_angle": _wrap_angle(e.position_angle),
        "sky": sky,
        "seeing": seeing,
        "zero_point": band.zero_point - extinction_mag if e.zero_point is None else e.zero_point,
        "airmass": airmass,
        "zenith": zenith,
    }


def _seeing(e: Exposure, band: _Band, seed: int) -> float:
    """Drawn from the survey's log-normal distribution, between three standard deviations; 0 in space."""
    if band.scatter == 0.0:
        return band.seeing
    where = (e.camera, e.band, *(value.hex() for value in (e.ra, e.dec, e.mjd)))
    normal = float(np.clip(rng.stream(seed, "exposures.seeing", *where).standard_normal(), -3.0, 3.0))
    return float(band.seeing * 10.0 ** (band.scatter * normal))


def untilted_exposure(grism: str, mission: MissionConfiguration) -> ExposureRow:
    """An exposure of a second through a grism that is not turned, at nothing in particular.

    grism : one of GRISMS;  mission : the mission database
    """
    camera, band = "nisp", next(band for band, names in GRISMS.items() if grism in names)
    return ExposureRow(
        0, "NISP-S", camera, band, "science", 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0,
        zero_point_of(camera, band, mission), "", grism=grism, grism_angle=traces.direction(grism, camera, mission),
    )  # fmt: skip


def zero_point_of(prefix: str, band: str, mission: MissionConfiguration, curve: Passband | None = None) -> float:
    """AB magnitude of one electron a second: of ground cameras as published, of Euclid's from throughput and area.

    curve : the passband, None = the embedded one
    prefix : of the camera's keys in the mission database;  band : name;  mission : the mission database
    """
    if f"{prefix}.{band}.zero_point" in mission:
        return mission.value(f"{prefix}.{band}.zero_point", "mag")
    return units.zero_point(
        mission.value("plm.collecting_area", "cm2"), passbands.log_width(curve or passbands.load(band))
    )
