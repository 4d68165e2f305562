"""Bright exposures of NISP, each with darks after it that show what it left in the detectors.

exposures   what an observation block of the image type persistence asks for
forgotten   when nothing is seen any more of what an exposure leaves
"""

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
from truesky.request.observations import Observation

_DAY_S = 86400.0


def exposures(first: Exposure, block: Observation, mission: MissionConfiguration, now: float) -> Iterator[Exposure]:
    """Each bright exposure, then its darks; the next when it is forgotten.

    first   : where they point;  now : MJD of the first of them
    block   : of the request;  mission : the mission database
    Errors  : BadInput for darks that begin before another has ended, or so late that nothing is looked for any more
    """
    band = FILTERS[-1] if first.channel == "NISP-P" else RED
    nominal = exposure_time(first.channel, first.camera, band, mission)
    dark = replace(first, band=band, exposure_time_s=block.exposure_time_s or nominal)
    busy = elapsed_time(dark, mission)
    for bright in _bright(first, block, mission):
        ends = now + elapsed_time(bright, mission) / _DAY_S
        longest = mission.value(f"{first.camera}.persistence.window", "s") - (ends - now) * _DAY_S
        delays = _checked(block.delays_s, busy, longest) if block.delays_s else _listed(busy, longest, mission)
        yield replace(bright, mjd=now)
        darks = [replace(dark, band=bright.band, mjd=ends + seconds / _DAY_S) for seconds in delays]
        yield from darks
        now = forgotten(darks[-1], mission)


def forgotten(exposure: Exposure, mission: MissionConfiguration) -> float:
    """MJD from which nothing is seen of what an exposure leaves in NISP's detectors; mission : the mission database."""
    window = mission.value(f"{exposure.camera}.persistence.window", "d")
    return exposure.mjd + elapsed_time(exposure, mission) / _DAY_S + window


def _checked(delays: Sequence[float], busy: float, longest: float) -> Sequence[float]:
    """The block's in their order; busy : s that a dark takes;  longest : s that are looked back from one's start."""
    delays = sorted(delays)
    for before, after in pairwise(delays):
        if after < before + busy:
            raise BadInput(f"delays_s: a dark at {after:g} s begins before that at {before:g} s, of {busy:.1f} s, ends")
    if delays[-1] > longest:
        raise BadInput(f"delays_s: {delays[-1]:g} s is more than nisp.persistence.window looks back, {longest:g} s")
    return delays


def _listed(busy: float, longest: float, mission: MissionConfiguration) -> Sequence[float]:
    """Of the mission's those that such darks can be taken at; busy, longest, mission : as of `_checked`."""
    found: list[float] = []
    names = takewhile(mission.__contains__, (f"nisp.persistence.delay_{i}" for i in count(1)))
    for seconds in (mission.value(name, "s") for name in names):
        if (not found or seconds >= found[-1] + busy) and seconds <= longest:
            found.append(seconds)
    if not found:
        raise BadInput(f"delays_s: of the mission's none is within the {longest:g} s that are looked back")
    return found


def _bright(first: Exposure, block: Observation, mission: MissionConfiguration) -> Iterator[Exposure]:
    """Flats of the block's lamps at its intensities, or a field of stars in each band."""
    of_sky, channel = block.bright == "sky", first.channel
    if of_sky and (block.lamps or block.intensities):
        raise BadInput(f"{'lamps' if block.lamps else 'intensities'}: bright = 'sky' has no lamp")
    if not of_sky:
        kind = "flat"
    else:
        kind = "self_calibration" if "self_calibration" in registry.CHANNELS[channel].effects else "science"
    in_bands = [
        replace(first, image_type=kind, band=band, exposure_time_s=exposure_time(channel, first.camera, band, mission))
        for band in lit_flats.chosen(block.bands, FILTERS if channel == "NISP-P" else (RED,))
    ]
    if of_sky:
        lit = [[through_grism(frame, None, mission) for frame in in_bands]]
    else:
        lit = lit_flats.by_lamp(in_bands, block, mission)
    for i in range(block.exposures or 1):
        turn, own = i // len(lit), lit[i % len(lit)]
        shown = own[turn % len(own)]
        yield from [shown] if of_sky else lit_flats.at_levels(shown, block, mission)
