"""Define planned exposures, and convert them to rows of the table `exposures`.

The rows also have the sky background, the photometric zero point and the seeing, which are computed here.
"""

from __future__ import annotations

import math
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
from truesky.render.sky import clouds, ice, night_sky, observatory
from truesky.render.sky.diffuse_light import SkyBand, sky_rate
from truesky.render.sky.night_sky import Night
from truesky.request.exposures.observations import Observation

# Names of the NISP grisms, by the passband in which they are used.
GRISMS: Mapping[str, tuple[str, ...]] = {"nisp_red": ("RGS000", "RGS180"), "nisp_blue": ("BGS000",)}
# Image types whose exposures contain no light of the sky, so that their column `sky` is 0.
_DARK_TYPES = ("bias", "dark", "charge_injection", "trap_pumping", "persistence")
# Columns of the table `exposures` that are not attributes of `Exposure`, because the function `table` computes them.
_COMPUTED_COLUMNS = ("exposure_id", "realisation", "airmass", "zenith", "clouds", "sky_slope_x", "sky_slope_y")


@dataclass(frozen=True, slots=True)
class Exposure:
    """A planned exposure of a camera.

    Attributes
    ----------
    channel : str
        "VIS", "NISP-P" (filters), "NISP-S" (grisms) or "EXT" (ground).
    camera, band, image_type : str
        Names of the camera and the passband; type of image such as "science", "dark" or "flat".
    ra, dec : float
        ICRS position of the boresight in degrees.
    position_angle : float
        Angle of the y axis of the focal plane in degrees, from north through east.
    mjd : float
        Start of the exposure.
    exposure_time_s : float
        Effective exposure time in seconds.
    survey : str
        Name of the survey.
    field, visit, dither : int, optional
        Numbers from 1 of the field in the survey, of its visit, and of the dither.
    grism : str, optional
        Name of the grism; None for an image.
    grism_angle : float, optional
        Direction of the spectra in the focal plane in degrees, from the x axis towards the y axis; None for an image.
    lamp : int, optional
        Number from 1 of the lamp of the calibration unit that lights a flat.
    target : str, optional
        Name of the calibrator on the sky.
    psf : str, optional
        The user's PSF file; None means the PSF model of the camera.
    detectors : tuple of str
        Names of the detectors; () means all detectors of the camera.
    sky : float, optional
        Sky background in electrons per second and pixel; None means that it is computed.
    seeing : float, optional
        Seeing in arcsec, at the zenith and at 500 nm; None means that it is drawn at random for ground cameras, and 0
        in space.
    zero_point : float, optional
        AB magnitude of a source with one electron per second without clouds; None means that it is computed.
    clouds : float
        Mean extinction by clouds of the night in magnitudes, for ground cameras; 0 for a clear night.
    settings : str, optional
        JSON table of parameters that replace the values of the request; None if nothing is replaced.
    parameters : tuple of (str, float, str)
        Name, value and unit of parameters that replace the values of the mission database for this exposure alone.
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
    clouds: float = 0.0
    settings: str | None = None
    parameters: tuple[tuple[str, float, str], ...] = ()


def bands_of(channel: str, camera: str, mission: MissionConfiguration) -> tuple[str, ...]:
    """Return the names of the passbands that a camera has in a channel.

    Parameters
    ----------
    channel, camera : str
        Names of the channel ("VIS", "NISP-P", "NISP-S" or "EXT") and of the camera.
    mission : MissionConfiguration
        Mission database: parameters of the telescopes, cameras and survey.

    Returns
    -------
    tuple of str
        Names of the passbands.

    Raises
    ------
    BadInput
        If the channel has no such camera.
    KeyError
        If the channel is unknown.
    """
    bands = registry.CHANNELS[channel].bands(camera, mission)
    if not bands:
        raise BadInput(f"channel {channel} has no camera {camera!r}")
    return bands


def through_grism(exposure: Exposure, angle: float | None, mission: MissionConfiguration, where: str = "") -> Exposure:
    """Return an exposure through the grism of its band whose spectra run closest to an angle.

    Parameters
    ----------
    exposure : Exposure
        The exposure.
    angle : float or None
        Requested direction of the spectra in the focal plane in degrees, from the x axis towards the y axis; None
        means 0.
    mission : MissionConfiguration
        Mission database, with the directions of the grisms.
    where : str
        Place in the request that gives the angle, quoted in the error message.

    Returns
    -------
    Exposure
        The exposure with `grism` and `grism_angle`; unchanged if its band has no grism and `angle` is None.

    Raises
    ------
    BadInput
        If the band has no grism but an angle is given. Also if every grism of the band would have to be tilted by more
        than `grism_wheel.MAX_TILT` degrees.
    """
    grisms = GRISMS.get(exposure.band, ())
    if not grisms:
        if angle is not None:
            raise BadInput(f"{where}: must not be set in {exposure.band}, for which {exposure.camera} has no grism")
        return exposure
    angle, section = angle or 0.0, image_types.section(exposure.camera)
    tilts = [abs(grism_wheel.tilt(grism, angle, section, mission)) for grism in grisms]
    nearest = int(np.argmin(tilts))
    if tilts[nearest] > grism_wheel.MAX_TILT:
        names = ", ".join(grisms)
        raise BadInput(f"{where} = {angle:g} deg tilts {names} by more than {grism_wheel.MAX_TILT:g} deg")
    return replace(exposure, grism=grisms[nearest], grism_angle=angle)


def exposure_time(channel: str, camera: str, band: str, mission: MissionConfiguration) -> float:
    """Return the nominal effective exposure time of a camera in the mission database.

    Parameters
    ----------
    channel, camera, band : str
        Names of the channel, of the camera and of the passband. NISP ignores the band, other cameras the channel.
    mission : MissionConfiguration
        Mission database: parameters of the telescopes, cameras and survey.

    Returns
    -------
    float
        Time in seconds. For NISP, which is read up the ramp, it is the time between the first and last group of reads.
    """
    if camera == "nisp":
        kind = f"nisp.macc.{_ramp_name(channel)}"
        groups, reads, drops = (mission.value(f"{kind}.{part}") for part in ("groups", "reads", "drops"))
        return (groups - 1) * (reads + drops) * mission.value("nisp.frame_time", "s")
    key = f"{image_types.section(camera)}.{band}.exposure_time"
    return mission.value(key if key in mission else f"{image_types.section(camera)}.exposure_time", "s")


def elapsed_time(exposure: Exposure, mission: MissionConfiguration) -> float:
    """Return the seconds from the start of an exposure until its detectors may be exposed again.

    For NISP, which is read up the ramp, the result is the time from the reset to the last read. For other cameras it is
    the exposure time.
    """
    if exposure.camera != "nisp":
        return exposure.exposure_time_s
    return ramp.duration(_ramp_name(exposure.channel), exposure.exposure_time_s, exposure.camera, mission)


def check_ramp(channel: str, camera: str, seconds: float, mission: MissionConfiguration, where: str = "") -> None:
    """Check that NISP can take an exposure time with its up-the-ramp readout; other cameras are not checked.

    Parameters
    ----------
    channel, camera : str
        Names of the channel and of the camera.
    seconds : float
        Exposure time in seconds.
    mission : MissionConfiguration
        Mission database, with the numbers of groups, reads and dropped frames of a ramp.
    where : str
        Place in the request that gives the exposure time, quoted in the error message.

    Raises
    ------
    BadInput
        If no ramp takes this time.
    """
    if camera == "nisp":
        try:
            ramp.find_mode(_ramp_name(channel), seconds, camera, mission)
        except BadInput as error:
            raise BadInput(f"{where}: {error}" if where else str(error)) from None


def check_macc(block: Observation, mission: MissionConfiguration) -> None:
    """Raise BadInput if an observation sets a NISP ramp and an exposure time that disagree.

    The ramp is `block.macc`: numbers of groups, reads and dropped frames. `mission` must already contain them.
    """
    if not block.macc or block.exposure_time_s is None:
        return
    ramp_seconds = exposure_time(channel_of_macc(block), "nisp", "", mission)
    if abs(block.exposure_time_s / ramp_seconds - 1.0) > ramp.FRAME_TOLERANCE:
        raise BadInput(
            f"macc = {[*block.macc]} takes {ramp_seconds:.4g} s, not exposure_time_s = {block.exposure_time_s:g}"
        )


def channel_of_macc(block: Observation) -> str:
    """Return the NISP channel to which the key `macc` (groups, reads and drops of a ramp) of an observation applies.

    The result is "NISP-P" if this channel is among the channels of the observation, otherwise "NISP-S".
    """
    return "NISP-P" if "NISP-P" in block.channels else "NISP-S"


def ramp_overrides(block: Observation) -> dict[str, tuple[float, str]]:
    """Return (value, unit) by name for the mission parameters that the ramp of an observation replaces.

    A ramp (up-the-ramp readout of NISP) has these parameters: the number of groups, of averaged reads per group, and of
    dropped frames between groups. The result is {} if the observation sets no ramp.
    """
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
    """Make the rows of the table `exposures`, numbered in the order in which the exposures are given.

    Parameters
    ----------
    exposures : sequence of Exposure
        Planned exposures.
    missions : sequence of MissionConfiguration
        Mission parameters of each exposure, same length.
    user_passbands : mapping of str to Passband, optional
        The user's passbands by name, in addition to the passbands of truesky.
    seed : int
        Seed of the request, used to draw the seeing of ground cameras.
    first : int
        Number of the first exposure.
    previous : iterable of Exposure
        Exposures before the given ones. The column `realisation` numbers exposures that differ only in their noise; the
        previous exposures are counted first, but get no rows.

    Returns
    -------
    pyarrow.Table
        One row per exposure; an empty table without exposures.
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
    """Return the properties (such as changed parameters, camera, pointing and date) that repetitions have in common.

    Exposures with equal properties are repetitions of one exposure. Different numbers in the column `realisation` give
    them different noise.
    """
    angle = _wrap_angle(e.position_angle)
    return e.settings, e.camera, e.band, e.ra % 360.0, e.dec, angle, e.mjd, e.grism, e.grism_angle


def _wrap_angle(angle: float) -> float:
    return (angle + 180.0) % 360.0 - 180.0


@dataclass(frozen=True, slots=True)
class _Band:
    """Properties shared by all exposures of a channel and camera in a band.

    `zero_point` is the AB magnitude of one electron per second, and `sky` the model of the sky brightness. `seeing` is
    the median FWHM (arcsec) of the air at the zenith and at 500 nm, and `scatter` its log-normal scatter (dex). Three
    fields are None for cameras in space: `night` (night sky of the site), `detector` (first one of the camera) and
    `curve` (passband).
    """

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
        seeing = mission.value(f"{prefix}.seeing", "arcsec")
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
    cloud_mag: float | None = None
    slopes: tuple[float | None, float | None] = (None, None)
    seeing = _seeing(e, band, seed) if e.seeing is None else e.seeing
    if night is not None and band.detector is not None and band.curve is not None:
        airmass, zenith = observatory.airmass_and_zenith(e.ra, e.dec, e.mjd, night.site)
        if e.psf is None:
            ground_psf.check(seeing, airmass, band.detector, band.curve, mission)
        extinction_mag = night_sky.extra_extinction(night, airmass)
        if registry.CHANNELS[e.channel].sees_sky(e.image_type):
            cloud_mag = clouds.extinction(e.clouds, e.mjd, e.exposure_time_s, night.site.longitude, seed)
            slopes = night_sky.twilight_slopes(night, (e.ra, e.dec), e.position_angle, e.mjd, mission)
    channel = registry.CHANNELS[e.channel]
    # A zero point of the user contains all losses.
    has_ice = e.camera in SPACE_CAMERAS and e.zero_point is None
    passed = ice.transmission(e.band, e.mjd, mission) if has_ice else 1.0
    extinction_mag -= 2.5 * math.log10(passed)
    if e.image_type in _DARK_TYPES or (channel.on_ground and not channel.sees_sky(e.image_type)):
        sky = 0.0
    elif sky is None and night is not None:
        sky = night_sky.sky_rate(night, e.ra, e.dec, e.mjd, mission)
    elif sky is None:
        sky = sky_rate(band.sky, e.ra, e.dec, e.mjd, mission) * passed
    return {
        **{name: getattr(e, name) for name in EXPOSURES.names if name not in _COMPUTED_COLUMNS},
        "exposure_id": number,
        "ra": e.ra % 360.0,
        "position_angle": _wrap_angle(e.position_angle),
        "sky": sky,
        "seeing": seeing,
        "zero_point": (band.zero_point - extinction_mag if e.zero_point is None else e.zero_point) - (cloud_mag or 0.0),
        "airmass": airmass,
        "zenith": zenith,
        "clouds": cloud_mag,
        "sky_slope_x": slopes[0],
        "sky_slope_y": slopes[1],
    }


def _seeing(e: Exposure, band: _Band, seed: int) -> float:
    """Draw the seeing (arcsec, at the zenith and at 500 nm) of a ground camera.

    It has a log-normal distribution, limited to 3 sigma.
    The result is 0 in space. The same seed, camera, band, position and date always give the same seeing.
    """
    if band.scatter == 0.0:
        return band.seeing
    where = (e.camera, e.band, *(value.hex() for value in (e.ra, e.dec, e.mjd)))
    normal = float(np.clip(rng.stream(seed, "exposures.seeing", *where).standard_normal(), -3.0, 3.0))
    return float(band.seeing * 10.0 ** (band.scatter * normal))


def untilted_exposure(grism: str, mission: MissionConfiguration) -> ExposureRow:
    """Return a one-second exposure of the sky at ra = dec = 0 through a grism that is not tilted.

    `grism` is a name in `GRISMS`; raises StopIteration for other names.
    """
    camera, band = "nisp", next(band for band, names in GRISMS.items() if grism in names)
    return ExposureRow(
        0, "NISP-S", camera, band, "science", 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0,
        zero_point_of(camera, band, mission), "", grism=grism, grism_angle=traces.direction(grism, camera, mission),
    )  # fmt: skip


def zero_point_of(prefix: str, band: str, mission: MissionConfiguration, curve: Passband | None = None) -> float:
    """Return the photometric zero point of a band: the AB magnitude of a source with one electron per second.

    Parameters
    ----------
    prefix : str
        Beginning of the names of the camera's parameters in the mission database, such as "vis" or "ext.decam".
    band : str
        Name of the band.
    mission : MissionConfiguration
        Mission database: parameters of the telescopes, cameras and survey.
    curve : Passband, optional
        Response of the band; None means the passband of truesky.

    Returns
    -------
    float
        Zero point in magnitudes. It is the one in the mission database if the band has one there (ground cameras),
        otherwise it follows from the passband and the collecting area of Euclid.
    """
    if f"{prefix}.{band}.zero_point" in mission:
        return mission.value(f"{prefix}.{band}.zero_point", "mag")
    return units.zero_point(
        mission.value("plm.collecting_area", "cm2"), passbands.log_width(curve or passbands.load(band))
    )
