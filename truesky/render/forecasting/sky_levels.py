"""Describe the sky of planned exposures: its brightness in each band, and the causes of this brightness."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.parameter import SPACE_CAMERAS
from lake_schema.sky import separation
from truesky.fluxes import passbands
from truesky.render.camera import detectors
from truesky.render.channels import image_types, registry
from truesky.render.planning import variants
from truesky.render.planning.mission import mission_of, user_filters
from truesky.render.planning.planned_exposures import zero_point_of
from truesky.render.sky import diffuse_light, night_sky, observatory
from truesky.render.sky.night_sky import Night
from truesky.request.schema import Request

# Columns of the table `exposures` that are used.
_COLUMNS = ("channel", "camera", "band", "image_type", "ra", "dec", "mjd", "sky", "airmass", "settings")
# Smallest part of the sky that is named as a cause.
_NOTICEABLE = 0.01
# Largest relative difference of a sky from the model by which it is recognised as the model's.
_TOLERANCE = 1e-6


@dataclass(slots=True)
class _BandSky:
    """Exposures of a camera in a band: their number, the one with the brightest sky, and the rate of the faintest."""

    count: int
    brightest: Mapping[str, Any]
    faintest: float


class SkyLevels:
    """Sky of the exposures of a request by camera and band, collected while the plan is made chunk by chunk.

    Parameters
    ----------
    request : Request
        The request.
    """

    def __init__(self, request: Request) -> None:
        self._request = request
        self._bands: dict[tuple[str, str], _BandSky] = {}

    def add(self, exposures: pa.Table) -> None:
        """Add a chunk of a plan: rows of the table `exposures`."""
        table = exposures.select(_COLUMNS).filter(pc.greater(exposures["sky"], 0.0))
        for camera, band in dict.fromkeys(zip(table["camera"].to_pylist(), table["band"].to_pylist(), strict=True)):
            rows = table.filter(pc.and_(pc.equal(table["camera"], camera), pc.equal(table["band"], band)))
            rates = rows["sky"].to_numpy()
            brightest = rows.slice(int(np.argmax(rates)), 1).to_pylist()[0]
            previous = self._bands.get((camera, band), _BandSky(0, brightest, float("inf")))
            if previous.brightest["sky"] >= brightest["sky"]:
                brightest = previous.brightest
            self._bands[camera, band] = _BandSky(
                previous.count + len(rates), brightest, min(previous.faintest, float(rates.min()))
            )

    def lines(self) -> Iterator[str]:
        """Yield one line per camera and band: the brightest sky of its exposures with its causes."""
        if not self._bands:
            return
        mission_for = variants.mission_lookup(mission_of(self._request.mission))
        curves = user_filters(self._request)[0]
        for (camera, band), sky in self._bands.items():
            row = sky.brightest
            mission = mission_for(row["settings"])
            detector = detectors.detectors(camera, mission)[0]
            curve = curves.get(band)
            zero_point = zero_point_of(image_types.section(camera), band, mission, curve)
            levels = [
                diffuse_light.brightness_of_rate(rate, detector, band, zero_point, mission)
                for rate in (row["sky"], sky.faintest)
            ]
            range_text = f"; brightest of {sky.count} exposures, faintest {levels[1]:.2f}" if sky.count > 1 else ""
            cause = describe_cause(row, curve or passbands.load(band), zero_point, mission)
            yield (
                f"sky of {band}: {levels[0]:.2f} mag/arcsec2, {row['sky']:.4g} electron/s/pixel on MJD "
                f"{row['mjd']:.3f}: {cause}{range_text}"
            )


def describe_cause(
    row: Mapping[str, Any], curve: passbands.Passband, zero_point: float, mission: MissionConfiguration
) -> str:
    """Return the causes of the sky of an exposure, such as "dark sky, Moon 35 % lit at 64 deg, airmass 1.21".

    Parameters
    ----------
    row : mapping
        Row of the table `exposures`.
    curve : Passband
        Response of the band.
    zero_point : float
        AB magnitude of a source with one electron per second.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    str
        Causes in the order of their description. Moon and twilight are named if they are more than 1 % of the sky.
    """
    channel = registry.CHANNELS[row["channel"]]
    if row["camera"] in SPACE_CAMERAS or not channel.sees_sky(row["image_type"]):
        return "zodiacal light, light scattered or emitted by the telescope"
    detector = detectors.detectors(row["camera"], mission)[0]
    level = channel.sky(detector, row["band"], mission, curve).constant
    night = Night.from_detector(detector, row["band"], (zero_point, level), mission, curve)
    ra, dec, mjd = row["ra"], row["dec"], row["mjd"]
    parts = night_sky.sky_components(night, ra, dec, mjd, mission)
    is_given = abs(parts.total / row["sky"] - 1.0) > _TOLERANCE
    causes = ["given by the request" if is_given else "dark sky" if night.modelled else "mean of the survey"]
    if parts.moon > _NOTICEABLE * parts.total:
        moon_ra, moon_dec, _ = (float(x) for x in observatory.moon_position(mjd))
        lit, away = float(observatory.moon_lit_fraction(mjd)), float(separation(ra, dec, moon_ra, moon_dec))
        causes.append(f"Moon {100.0 * lit:.0f} % lit at {away:.0f} deg")
    if parts.twilight > _NOTICEABLE * parts.total:
        causes.append(f"twilight, Sun at {observatory.sun_direction(mjd, night.site)[0]:.1f} deg")
    return ", ".join([*causes, f"airmass {row['airmass']:.2f}"])
