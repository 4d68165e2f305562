"""Plan flat fields lit by the lamps (LEDs) of a calibration unit: which lamp in which band, at which brightness."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain, repeat

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from truesky.fluxes import passbands
from truesky.render.camera.lamps import LAMPS
from truesky.render.channels import image_types
from truesky.render.effects.light import calibration_lamp
from truesky.render.planning.planned_exposures import Exposure, through_grism
from truesky.request.exposures.observations import Observation

# A flat is taken only if the band detects more than this fraction of the lamp's photons. The fraction is relative to
# the highest response of the camera's built-in passbands.
_MIN_RELATIVE_SIGNAL = 0.05


def series(band_exposures: Sequence[Exposure], block: Observation, mission: MissionConfiguration) -> Iterator[Exposure]:
    """Yield the flats of an observation: `block.exposures` of each lamp, in each band that sees it, at each intensity.

    Flats that differ only in their noise follow one another, so that the difference of two of them measures the gain.

    Parameters
    ----------
    band_exposures : sequence of Exposure
        One flat per band, all of the same camera; at least one.
    block : Observation
        Observation block of the request, with its lamps, intensities and number of exposures.
    mission : MissionConfiguration
        Mission database, with the spectra of the lamps and the signal of a flat.

    Yields
    ------
    Exposure
        One flat.

    Notes
    -----
    BadInput is raised as by `by_lamp`.
    """
    for flat in chain.from_iterable(by_lamp(band_exposures, block, mission)):
        for level in at_levels(flat, block, mission):
            yield from repeat(level, block.exposures)


def by_lamp(
    band_exposures: Sequence[Exposure], block: Observation, mission: MissionConfiguration
) -> list[list[Exposure]]:
    """Return for each lamp one flat in each band in which the lamp is bright enough.

    Parameters
    ----------
    band_exposures : sequence of Exposure
        One flat per band, all of the same camera; at least one.
    block : Observation
        Observation block of the request. Its `lamps` are used, or all lamps of the camera if it names none. Ground
        cameras have one lamp, which all bands see.
    mission : MissionConfiguration
        Mission database, with the spectra of the lamps.

    Returns
    -------
    list of list of Exposure
        One list of flats per lamp. Lamps that are too faint in all bands are omitted.

    Raises
    ------
    BadInput
        If a lamp that the block names is too faint in all bands, or if all lamps are.
    """
    camera, flats = band_exposures[0].camera, []
    if camera not in LAMPS:
        return [[replace(frame, lamp=1) for frame in band_exposures]]
    curves = {frame.band: passbands.load(frame.band) for frame in band_exposures}
    for lamp in block.lamps or range(1, LAMPS[camera][0] + 1):
        signals = {
            band: calibration_lamp.led_efficiency(curve, lamp, camera, mission) for band, curve in curves.items()
        }
        frames = [replace(frame, lamp=lamp) for frame in band_exposures if signals[frame.band] > _MIN_RELATIVE_SIGNAL]
        # Flats of NISP-S are taken with the grism in the beam. Flats in other channels do not change here.
        lamp_flats = [through_grism(frame, None, mission) for frame in frames]
        if block.lamps and not lamp_flats:
            nm = mission.value(f"{camera}.flat.led_{lamp}", "nm")
            raise BadInput(f"lamps: {lamp} ({nm:g} nm) is not visible in {', '.join(curves)}")
        if lamp_flats:
            flats.append(lamp_flats)
    if not flats:
        raise BadInput(f"bands: no lamp is visible in {', '.join(curves)}")
    return flats


def at_levels(flat: Exposure, block: Observation, mission: MissionConfiguration) -> Iterator[Exposure]:
    """Yield the flat once for each intensity of the observation.

    Parameters
    ----------
    flat : Exposure
        A flat with the signal of the mission database.
    block : Observation
        Observation block of the request. Its `intensities` are relative to the signal in the mission database; none
        means a single flat with intensity 1.
    mission : MissionConfiguration
        Mission database, with the signal of a flat in electrons.

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
    """Return the bands of a channel that are also in `requested`, or all bands of the channel if none is."""
    return [band for band in channel_bands if band in requested] or channel_bands
