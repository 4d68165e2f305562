"""Plan flats with a calibration unit: lamps, the bands in which they are visible, and brightness."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from truesky.fluxes import passbands
from truesky.render.camera.lamps import LAMPS
from truesky.render.channels import image_types
from truesky.render.effects.light import calibration_lamp
from truesky.render.planning.planned_exposures import Exposure, through_grism
from truesky.request.observations import Observation

# Smallest signal of a lamp in a band for which a flat is taken, relative to the peak response of the camera's bands.
_MIN_RELATIVE_SIGNAL = 0.05


def by_lamp(
    band_exposures: Sequence[Exposure], block: Observation, mission: MissionConfiguration
) -> list[list[Exposure]]:
    """Group the flats by lamp: one flat in each band in which the lamp is visible.

    Parameters
    ----------
    band_exposures : sequence of Exposure
        One flat per band.
    block : Observation
        Observation block of the request; its lamps, or all lamps of the camera if it names none.
    mission : MissionConfiguration
        The mission database.

    Returns
    -------
    list of list of Exposure
        Flats of each lamp. Lamps that are not visible in any band are omitted.

    Raises
    ------
    BadInput
        If a lamp of the block is not visible in its bands, or no lamp is.
    """
    camera, flats = band_exposures[0].camera, []
    curves = {frame.band: passbands.load(frame.band) for frame in band_exposures}
    for lamp in block.lamps or range(1, LAMPS[camera][0] + 1):
        signals = {
            band: calibration_lamp.led_efficiency(curve, lamp, camera, mission) for band, curve in curves.items()
        }
        frames = [replace(frame, lamp=lamp) for frame in band_exposures if signals[frame.band] > _MIN_RELATIVE_SIGNAL]
        # Flats of NISP-S are taken with the grism in the beam.
        lamp_flats = [through_grism(frame, None, mission) for frame in frames]
        if block.lamps and not lamp_flats:
            raise BadInput(f"lamps: {lamp} is not visible in {', '.join(curves)}")
        if lamp_flats:
            flats.append(lamp_flats)
    if not flats:
        raise BadInput(f"bands: no lamp is visible in {', '.join(curves)}")
    return flats


def at_levels(flat: Exposure, block: Observation, mission: MissionConfiguration) -> Iterator[Exposure]:
    """Yield the flat at each intensity of the block, relative to the signal in the mission database.

    Parameters
    ----------
    flat : Exposure
        A flat.
    block : Observation
        Observation block of the request.
    mission : MissionConfiguration
        The mission database.

    Yields
    ------
    Exposure
        The flat at one intensity.
    """
    key = f"{image_types.section(flat.camera)}.flat.signal"
    for intensity in block.intensities or (1.0,):
        level = (key, intensity * mission.value(key, "electron"), "electron")
        yield flat if intensity == 1.0 else replace(flat, parameters=(level,))


def select_bands(requested: Sequence[str], channel_bands: Sequence[str]) -> Sequence[str]:
    """Return the bands of a channel that are requested, or all bands if none of them is requested."""
    return [band for band in channel_bands if band in requested] or channel_bands
