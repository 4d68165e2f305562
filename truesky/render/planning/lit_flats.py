"""Flats of a calibration unit: which of its lamps shine in which bands, and how brightly.

by_lamp     of each lamp a flat in every band that sees it
at_levels   a flat at each intensity that is asked for
chosen      bands that a block names
"""

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

# Of a lamp's light, over what the camera's bands see where they see best: with less a flat is not taken.
_MIN_RELATIVE_SIGNAL = 0.05


def by_lamp(
    band_exposures: Sequence[Exposure], block: Observation, mission: MissionConfiguration
) -> list[list[Exposure]]:
    """Of each lamp a flat in every band that sees it; lamps that no band sees are not lit.

    in_bands : a flat in each band;  block : of the request;  mission : the mission database
    Errors   : BadInput for a lamp of the block's that none of its bands sees, and where that are all of them
    """
    camera, flats = band_exposures[0].camera, []
    curves = {frame.band: passbands.load(frame.band) for frame in band_exposures}
    for lamp in block.lamps or range(1, LAMPS[camera][0] + 1):
        signals = {
            band: calibration_lamp.led_efficiency(curve, lamp, camera, mission) for band, curve in curves.items()
        }
        frames = [replace(frame, lamp=lamp) for frame in band_exposures if signals[frame.band] > _MIN_RELATIVE_SIGNAL]
        # Flats of spectra are taken with the grism in.
        lamp_flats = [through_grism(frame, None, mission) for frame in frames]
        if block.lamps and not lamp_flats:
            raise BadInput(f"lamps: {lamp} does not shine in {', '.join(curves)}")
        if lamp_flats:
            flats.append(lamp_flats)
    if not flats:
        raise BadInput(f"bands: no lamp shines in {', '.join(curves)}")
    return flats


def at_levels(flat: Exposure, block: Observation, mission: MissionConfiguration) -> Iterator[Exposure]:
    """A flat at each of the block's intensities, in their order; block, mission : as of `by_lamp`."""
    key = f"{image_types.section(flat.camera)}.flat.signal"
    for intensity in block.intensities or (1.0,):
        level = (key, intensity * mission.value(key, "electron"), "electron")
        yield flat if intensity == 1.0 else replace(flat, parameters=(level,))


def select_bands(requested: Sequence[str], channel_bands: Sequence[str]) -> Sequence[str]:
    """Those of a channel's bands that a block names, all where it names none of them."""
    return [band for band in channel_bands if band in requested] or channel_bands
