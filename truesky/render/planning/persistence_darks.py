"""Plan measurements of NISP persistence: bright exposures, each followed by darks with increasing delays."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import count, pairwise, takewhile

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from truesky.render.channels import registry
from truesky.render.planning import lit_flats
from truesky.render.planning.observing_sequence import FILTERS, RED
from truesky.render.planning.planned_exposures import Exposure, elapsed_time, exposure_time, through_grism
from truesky.request.exposures.observations import Observation

_DAY_S = 86400.0


def exposures(template: Exposure, block: Observation, mission: MissionConfiguration, now: float) -> Iterator[Exposure]:
    """Generate bright exposures, each followed by darks that measure its persistence.

    A bright exposure waits until the persistence of the previous one has faded.

    Parameters
    ----------
    template : Exposure
        Exposure with the pointing, camera and channel of all exposures to be made.
    block : Observation
        Observation block of the request: number and brightness of the bright exposures, delays of the darks.
    mission : MissionConfiguration
        Mission database; gives the delays if the block has none.
    now : float
        MJD at which the first bright exposure begins.

    Yields
    ------
    Exposure
        A bright exposure or a dark.

    Raises
    ------
    BadInput
        If darks overlap, or if a dark begins so late that persistence is no longer simulated. Also if lamps or
        intensities are given although the bright exposures are of the sky.
    """
    band = FILTERS[-1] if template.channel == "NISP-P" else RED
    nominal = exposure_time(template.channel, template.camera, band, mission)
    dark = replace(template, band=band, exposure_time_s=block.exposure_time_s or nominal)
    dark_duration = elapsed_time(dark, mission)
    for bright in _bright_exposures(template, block, mission):
        end_mjd = now + elapsed_time(bright, mission) / _DAY_S
        max_delay = mission.value(f"{template.camera}.persistence.window", "s") - (end_mjd - now) * _DAY_S
        delays = (
            _check_delays(block.delays_s, dark_duration, max_delay)
            if block.delays_s
            else _mission_delays(dark_duration, max_delay, mission)
        )
        yield replace(bright, mjd=now)
        darks = [replace(dark, band=bright.band, mjd=end_mjd + seconds / _DAY_S) for seconds in delays]
        yield from darks
        now = persistence_end_mjd(darks[-1], mission)


def persistence_end_mjd(exposure: Exposure, mission: MissionConfiguration) -> float:
    """Return the MJD after which the persistence that an exposure leaves in its detectors is no longer simulated."""
    window = mission.value(f"{exposure.camera}.persistence.window", "d")
    return exposure.mjd + elapsed_time(exposure, mission) / _DAY_S + window


def _check_delays(delays: Sequence[float], dark_duration: float, max_delay: float) -> Sequence[float]:
    """Return the user's delays of darks in seconds, sorted.

    Raises BadInput if a dark begins before the previous one has ended (after `dark_duration` s), or after `max_delay`
    s. Delays count from the end of the bright exposure.
    """
    delays = sorted(delays)
    for delay, next_delay in pairwise(delays):
        if next_delay < delay + dark_duration:
            raise BadInput(
                f"delays_s: the dark at {next_delay:g} s begins before the dark at {delay:g} s ends; "
                f"a dark takes {dark_duration:.1f} s"
            )
    if delays[-1] > max_delay:
        raise BadInput(f"delays_s: {delays[-1]:g} s is too late, nisp.persistence.window allows {max_delay:g} s")
    return delays


def _mission_delays(dark_duration: float, max_delay: float, mission: MissionConfiguration) -> Sequence[float]:
    """Return those delays of darks (s) in the mission database at which darks of `dark_duration` s do not overlap.

    Delays above `max_delay` s are left out. Raises BadInput if none remains.
    """
    delays: list[float] = []
    names = takewhile(mission.__contains__, (f"nisp.persistence.delay_{i}" for i in count(1)))
    for seconds in (mission.value(name, "s") for name in names):
        if (not delays or seconds >= delays[-1] + dark_duration) and seconds <= max_delay:
            delays.append(seconds)
    if not delays:
        raise BadInput(f"delays_s: no delay of the mission is at most {max_delay:g} s (nisp.persistence.window)")
    return delays


def _bright_exposures(template: Exposure, block: Observation, mission: MissionConfiguration) -> Iterator[Exposure]:
    """Generate the bright exposures: flats with the lamps and intensities of the observation, or images of the sky.

    Raises BadInput if the observation sets lamps or intensities for images of the sky.
    """
    is_sky, channel = block.bright == "sky", template.channel
    if is_sky and (block.lamps or block.intensities):
        raise BadInput(f"{'lamps' if block.lamps else 'intensities'} must not be set if bright = 'sky'")
    if not is_sky:
        kind = "flat"
    else:
        kind = "self_calibration" if "self_calibration" in registry.CHANNELS[channel].effects else "science"
    band_exposures = [
        replace(
            template, image_type=kind, band=band, exposure_time_s=exposure_time(channel, template.camera, band, mission)
        )
        for band in lit_flats.select_bands(block.bands, FILTERS if channel == "NISP-P" else (RED,))
    ]
    if is_sky:
        frames_by_lamp = [[through_grism(frame, None, mission) for frame in band_exposures]]
    else:
        frames_by_lamp = lit_flats.by_lamp(band_exposures, block, mission)
    for i in range(block.exposures or 1):
        cycle, lamp_frames = i // len(frames_by_lamp), frames_by_lamp[i % len(frames_by_lamp)]
        exposure = lamp_frames[cycle % len(lamp_frames)]
        yield from [exposure] if is_sky else lit_flats.at_levels(exposure, block, mission)
