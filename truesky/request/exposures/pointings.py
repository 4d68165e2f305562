"""Read the pointings of a request (a user's TOML file): single exposures, whose position and time the user gives."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from lake_schema.errors import BadInput, Mistakes
from truesky.request import instruments, sky_notation
from truesky.request.exposures.pointing_tables import CHANNELS, CLOUDS_LIMITS
from truesky.request.toml_values import (
    Toml,
    as_table,
    check_keys,
    integer,
    number,
    optional_number,
    string,
    strings,
    table_list,
)

if TYPE_CHECKING:
    from lake_schema.mission.configuration import MissionConfiguration

# Largest number of pointings in a request, and of copies of an exposure with different noise.
_MAX_POINTINGS, MAX_REALISATIONS = 100_000, 10_000
# Where keys belong that a pointing does not have.
_PLACES = dict.fromkeys(("dither", "visits", "fields", "pointings", "image_type"), "[[observation]]")


@dataclass(frozen=True, slots=True)
class Pointing:
    """One science exposure of a request, with its position and time.

    Attributes
    ----------
    channel : str
        VIS, NISP-P, NISP-S or EXT (ground cameras).
    camera : str
        Name of the camera in the mission database.
    band : str
        Name of the passband.
    ra, dec : float
        ICRS position in degrees of the boresight, or of the centre of detector `centre_on`.
    position_angle : float
        Position angle of the focal plane's y axis in degrees, from north through east.
    mjd : float, optional
        Start of the exposure (MJD, UTC). None for the first date after the launch of the mission at which the Sun
        allows the pointing (Euclid), or at which the field crosses the meridian at night (ground cameras).
    detectors : tuple of str
        Names of detectors to render; () for all detectors of the camera.
    centre_on : str, optional
        Detector whose centre has the position ra, dec.
    exposure_time_s : float, optional
        Exposure time in seconds; None for the value in the mission database.
    clouds : float
        Mean extinction in magnitudes by clouds that drift over a ground camera; 0 for a clear sky.
    realisations : int
        Number of exposures that differ only in their noise.
    grism_angle : float, optional
        Direction of NISP-S spectra in the focal plane in degrees; None for 0.
    """

    channel: str
    camera: str
    band: str
    ra: float
    dec: float
    position_angle: float
    mjd: float | None
    detectors: tuple[str, ...] = ()
    centre_on: str | None = None
    exposure_time_s: float | None = None
    clouds: float = 0.0
    realisations: int = 1
    grism_angle: float | None = None


def parse_pointings(
    table: Toml, mission: MissionConfiguration | None, user_bands: Collection[str] = ()
) -> tuple[Pointing, ...]:
    """Read the list `pointing` of a request, () if it is missing.

    Parameters
    ----------
    table : Toml
        The parsed request.
    mission : MissionConfiguration or None
        Mission parameters, which list the cameras, passbands and detectors. None if they are not valid; then these
        names are not checked.
    user_bands : collection of str, optional
        Names of the user's passbands.

    Returns
    -------
    tuple of Pointing
        The pointings in the order of the file.

    Raises
    ------
    BadInput
        If entries are not valid. There is one line for each mistake, which names the key.
    """
    with Mistakes() as mistakes:
        pointings = tuple(
            mistakes.read(_pointing, value, f"pointing[{i}]", mission, user_bands)
            for i, value in enumerate(table_list(table, "pointing", _MAX_POINTINGS))
        )
    return pointings


def _pointing(value: object, path: str, mission: MissionConfiguration | None, user_bands: Collection[str]) -> Pointing:
    table = as_table(value, path, None)
    with Mistakes() as mistakes:
        read = mistakes.read
        read(check_keys, table, path, Pointing.__slots__, _PLACES)
        instrument = read(_instrument, table, path, mission, user_bands)
        pointing = Pointing(
            channel="",
            camera="",
            band="",
            ra=read(sky_notation.ra_of, table, f"{path}.ra"),
            dec=read(sky_notation.dec_of, table, f"{path}.dec"),
            position_angle=read(number, table, f"{path}.position_angle", -360.0, 360.0, 0.0, "deg"),
            mjd=read(sky_notation.optional_mjd, table, f"{path}.mjd"),
            exposure_time_s=read(optional_number, table, f"{path}.exposure_time_s", 0.0, 1e6, "s"),
            clouds=read(_clouds, table, f"{path}.clouds"),
            realisations=read(integer, table, f"{path}.realisations", 1, MAX_REALISATIONS, 1),
            grism_angle=read(optional_number, table, f"{path}.grism_angle", -360.0, 360.0, "deg"),
        )
        if instrument is not None and instrument["band"] not in user_bands:
            spectra = read(instruments.replace_grism, instrument["band"], pointing.grism_angle, f"{path}.grism_angle")
            instrument |= dict(zip(("band", "grism_angle"), spectra or (), strict=False))
    return replace(pointing, **instrument)


def _clouds(table: Toml, path: str) -> float:
    """Read the extinction by clouds of a ground camera, 0 if the key is missing. Raise BadInput for other channels."""
    if "clouds" in table and table.get("channel") in instruments.EUCLID_CAMERAS:
        raise BadInput(f"{path} is not for {table['channel']}: used by EXT")
    return number(table, path, *CLOUDS_LIMITS, 0.0, "mag")


def _instrument(
    table: Toml, path: str, mission: MissionConfiguration | None, user_bands: Collection[str]
) -> dict[str, Any]:
    """Read channel, camera, band and detectors of a pointing, and return them by key."""
    channel = string(table, f"{path}.channel", CHANNELS)
    with Mistakes() as mistakes:
        read = mistakes.read
        camera = read(_camera, table, path, channel, mission)
        detectors = read(strings, table, f"{path}.detectors")
        centre_on = read(string, table, f"{path}.centre_on") if "centre_on" in table else None
        band = read(string, table, f"{path}.band") if "band" in table else None
        if mission is not None and camera is not None:
            if band is None and "band" not in table:
                band = instruments.default_band(channel, camera, mission)
            elif band is not None and band not in user_bands:
                bands = instruments.band_names(channel, camera, mission)
                passband, _ = instruments.replace_grism(band, None, "")
                read(instruments.check_band, passband, bands, f"camera {camera}", f"{path}.band", mission)
            read(instruments.check_detectors, (camera,), detectors or (), mission, f"{path}.detectors")
            centred = (centre_on,) if centre_on else ()
            read(instruments.check_detectors, (camera,), centred, mission, f"{path}.centre_on")
    named = {"band": band or "", "detectors": detectors, "centre_on": centre_on}
    return {"channel": channel, "camera": camera, **named}


def _camera(table: Toml, path: str, channel: str, mission: MissionConfiguration | None) -> str:
    default = instruments.EUCLID_CAMERAS.get(channel)
    if mission is not None and default is None and "camera" not in table:
        names = ", ".join(instruments.camera_names(channel, mission))
        raise BadInput(f"{path}.camera is missing: channel {channel} requires one of {names}")
    camera = string(table, f"{path}.camera", default=default)
    if mission is not None:
        instruments.check_camera(channel, camera, mission, f"{path}.camera")
    return camera
