"""Plan the exposures of a Euclid field in order of time.

At each dither position, VIS and the grism of NISP observe at once, then the NISP filters follow one by one.

References
----------
Serrano et al. 2024, section 3.2 and the figure of the observing sequence
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from lake_schema.arrays import Float
from lake_schema.mission.configuration import MissionConfiguration
from truesky.randomness import rng
from truesky.render.camera import pointing
from truesky.render.camera.lamps import LEDS
from truesky.render.effects.charge import ramp
from truesky.render.planning.planned_exposures import Exposure, exposure_time, through_grism
from truesky.render.planning.reference_survey import Field
from truesky.request.exposures.observations import Observation
from truesky.request.instruments import detectors_of_camera

_DAY_S = 86400.0
# Passbands of the NISP filters, in the order in which a dither uses them after the spectrum through the grism.
FILTERS = ("euclid_j", "euclid_h", "euclid_y")
# Passbands of the red and of the blue grisms.
RED, BLUE = "nisp_red", "nisp_blue"
# Number of directions (deg) in which the red grisms disperse, one per dither. The mission database has them as
# survey.grism_angle_1 to 4.
N_GRISM_ANGLES = 4


def offsets(pattern: str, mission: MissionConfiguration, seed: int, *key: int | str) -> Float:
    """Return the offsets of the dithers from the pointing of a Euclid field.

    Parameters
    ----------
    pattern : str
        Name of the dither pattern: "S" or "J" with four dithers, or "none" with a single one. Not checked.
    mission : MissionConfiguration
        Mission database: offsets of the patterns, and the pointing error.
    seed : int
        Seed of the request, from which the pointing errors are drawn.
    *key : int or str
        Names and numbers of the field and visit. The same seed and key always give the same pointing errors.

    Returns
    -------
    float array, shape (n_dithers, 2)
        Offsets in arcsec along the x and y axes of the focal plane. They contain the pointing errors, which add up from
        one dither to the next; "none" gives one offset of exactly 0.
    """
    if pattern == "none":
        return np.zeros((1, 2))
    names = ["dither_1", "dither_2", "dither_3", "dither_4" if pattern == "S" else "dither_j_4"]
    planned = np.array([[mission.value(f"survey.{name}.{axis}", "arcsec") for axis in "xy"] for name in names])
    # The pointing error in the mission database is a 3-sigma value per step between dithers. The first dither has none.
    sigma = mission.value("svm.aocs.pointing_error", "arcsec") / 3.0
    errors = rng.stream(seed, "dithers", *key).normal(0.0, sigma, planned.shape)
    errors[0] = 0.0
    return planned + np.cumsum(errors, axis=0)


def visit_exposures(
    field: Field, block: Observation, survey: str, mission: MissionConfiguration, seed: int
) -> Iterator[Exposure]:
    """Generate the exposures of one visit of a Euclid field, dither by dither in order of time.

    Parameters
    ----------
    field : Field
        Position, number and start of the visit.
    block : Observation
        Observation block of the request; selects channels, bands, dither pattern and detectors.
    survey : str
        Survey name stored with the exposures.
    mission : MissionConfiguration
        Mission database, with the durations of exposures and slews.
    seed : int
        Seed of the request, used for pointing errors.

    Yields
    ------
    Exposure
        One exposure of VIS, NISP-S or NISP-P.
    """
    if isinstance(block.dither, str):
        # A field at a position given by the user has no number in a survey. Its position then selects the random
        # numbers.
        place = () if block.field_centre is None else tuple(angle.hex() for angle in block.field_centre)
        steps = offsets(block.dither, mission, seed, survey, field.number, field.visit, *place)
        # Shift the dithers so that their mean is the centre of the field.
        steps = steps - steps.mean(axis=0)
    else:
        # Use the user's offsets (arcsec) as they are, without pointing errors and without centring them.
        steps = np.array(block.dither)
    ra, dec = pointing.sky_of_plane(steps[:, 0], steps[:, 1], field.ra, field.dec, field.position_angle)
    length = _dither_time(mission)
    for i in range(len(steps)):
        start = field.mjd + i * (length + mission.value("svm.dither_slew_time", "s")) / _DAY_S
        dither = _Dither(block, field, survey, mission, float(ra[i]), float(dec[i]), start, i + 1)
        yield from dither.exposures(is_last=i + 1 == len(steps))


def _dither_time(mission: MissionConfiguration) -> float:
    """Return the seconds from the start of a dither to the end of the exposure in its last NISP filter."""
    spectrum, photometry = (_commanded_seconds(kind, mission) for kind in ("spectroscopic", "photometric"))
    settle, to_filter, wheel = _move_times(mission)
    return settle + spectrum + to_filter + len(FILTERS) * photometry + (len(FILTERS) - 1) * wheel


def _commanded_seconds(kind: str, mission: MissionConfiguration) -> float:
    """Return how long the observing sequence waits for a NISP exposure before the next operation, in seconds.

    `kind` is "spectroscopic" or "photometric". The result is the duration in the mission database, or that of the
    up-the-ramp readout if the readout takes longer.
    """
    seconds = exposure_time("NISP-S" if kind == "spectroscopic" else "NISP-P", "nisp", "", mission)
    return max(mission.value(f"nisp.commanded_time_{kind}", "s"), ramp.duration(kind, seconds, "nisp", mission))


def _move_times(mission: MissionConfiguration) -> tuple[float, float, float]:
    return (
        mission.value("svm.settle_time", "s"),
        mission.value("nisp.grism_to_filter_time", "s"),
        mission.value("nisp.wheel_time", "s"),
    )


@dataclass(frozen=True, slots=True)
class _Dither:
    """One dither (displaced pointing) of a visit of a Euclid field.

    `ra` and `dec` (deg) are its pointing, `start` its first MJD, and `dither` its number from 1.
    """

    block: Observation
    field: Field
    survey: str
    mission: MissionConfiguration
    ra: float
    dec: float
    start: float
    dither: int

    def exposures(self, is_last: bool) -> Iterator[Exposure]:
        """Generate the exposures of this dither: VIS, the NISP grism and the NISP filters, as far as requested.

        If requested, the first dither of a visit has a short VIS exposure, and the last one ends with a VIS flat.
        """
        block, mission = self.block, self.mission
        # The request may select some of the NISP filters; without a NISP filter in its bands, all are used.
        bands = set(block.bands) & set(FILTERS) or set(FILTERS)
        settle, to_filter, wheel = _move_times(mission)
        if "VIS" in block.channels:
            yield self._exposure("VIS", "euclid_vis", settle)
        if "NISP-S" in block.channels:
            yield self._spectral_exposure(settle)
        begin = settle + _commanded_seconds("spectroscopic", mission) + to_filter
        step = _commanded_seconds("photometric", mission) + wheel
        for i, band in enumerate(FILTERS):
            if "NISP-P" in block.channels and band in bands:
                yield self._exposure("NISP-P", band, begin + i * step)
        if "VIS" in block.channels and block.short and self.dither == 1:
            # The short exposure is taken during the last filter of the first dither (Serrano et al. 2024).
            seconds = mission.value("vis.exposure_time_short", "s")
            yield self._exposure("VIS", "euclid_vis", begin + (len(FILTERS) - 1) * step, seconds)
        if "VIS" in block.channels and block.flat and is_last:
            seconds = mission.value("vis.exposure_time_flat", "s")
            # The LEDs of the calibration unit are used in turn, from field to field and from visit to visit.
            lamp = (self.field.number + self.field.visit) % LEDS + 1
            flat = self._exposure("VIS", "euclid_vis", _dither_time(mission), seconds)
            yield replace(flat, image_type="flat", lamp=lamp)

    def _spectral_exposure(self, delay: float) -> Exposure:
        if self.block.blue and self.field.visit % 2 == 0:
            return through_grism(self._exposure("NISP-S", BLUE, delay), None, self.mission)
        number = (self.dither - 1) % N_GRISM_ANGLES + 1
        angle = self.mission.value(f"survey.grism_angle_{number}", "deg")
        return through_grism(self._exposure("NISP-S", RED, delay), angle, self.mission, f"survey.grism_angle_{number}")

    def _exposure(self, channel: str, band: str, delay: float, seconds: float | None = None) -> Exposure:
        """Return an exposure at the pointing of this dither that begins `delay` seconds after the start of the dither.

        `seconds` is the exposure time; None means the nominal one of the mission database.
        """
        camera = "vis" if channel == "VIS" else "nisp"
        nominal = exposure_time(channel, camera, band, self.mission)
        return Exposure(
            channel=channel,
            camera=camera,
            band=band,
            image_type=self.block.image_type,
            ra=self.ra,
            dec=self.dec,
            position_angle=self.field.position_angle,
            mjd=self.start + delay / _DAY_S,
            exposure_time_s=nominal if seconds is None else seconds,
            survey=self.survey,
            field=self.field.number,
            visit=self.field.visit,
            dither=self.dither,
            detectors=detectors_of_camera(camera, self.block.detectors, self.mission),
        )
