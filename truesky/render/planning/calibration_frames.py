"""Plan calibration exposures: bias, dark, flat, charge injection and trap pumping, and calibrators on the sky.

References
----------
Serrano et al. 2024, section 5.1 and the table of the pilot phase's products
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from truesky.randomness import rng
from truesky.render.camera import pointing
from truesky.render.channels import image_types, registry
from truesky.render.effects.readout import trap_pumping
from truesky.render.planning import lit_flats, persistence_darks
from truesky.render.planning.observing_sequence import FILTERS, N_GRISM_ANGLES, RED, offsets
from truesky.render.planning.planned_exposures import Exposure, bands_of, elapsed_time, exposure_time, through_grism
from truesky.render.sky.solar_aspect import check_aspect, next_allowed, position_angle
from truesky.request.exposures.observations import Observation
from truesky.request.instruments import detectors_of_camera

_DAY_S = 86400.0
# Names of the calibrators on the sky that each image type observes (two standard stars: Serrano et al. 2024).
TARGETS = {
    "standard_star": ("Vega", "white dwarf DA"),
    "planetary_nebula": ("planetary nebula",),
    "bleeding": ("Vega",),
    "stray_light": ("Vega",),
    "white_dwarf": ("white dwarf DA",),
}
# Parameters of a calibrator that a request may set: its AB magnitude, and its distance from the boresight. Each has the
# attribute of the observation, the end of the parameter's name in the mission database, and the unit.
_TARGET_PARAMETERS = (("magnitude", "magnitude", "mag"), ("distance_deg", "distance", "deg"))
# Number of durations of a clock phase of trap pumping that the mission database has. They are used, by default for one
# frame each, unless the observation gives its own durations.
_PHASE_TIMES = 4
# Seconds from the end of the exposure time of a calibration exposure to the start of the next exposure, which suffice
# for the slowest readout. If a NISP exposure lasts longer, the next one begins when it has ended.
_PAUSE = 90.0


def exposures(
    block: Observation, camera: str, centre: tuple[float, float], mission: MissionConfiguration, seed: int, start: float
) -> Iterator[Exposure]:
    """Generate the exposures of a calibration observation, one channel after another.

    Parameters
    ----------
    block : Observation
        Observation block of the request, whose image type is a calibration.
    camera : str
        Name of the ground camera, used for channel EXT; may be "" without this channel.
    centre : tuple of float
        ICRS ra and dec (deg) at which the telescope points.
    mission : MissionConfiguration
        Mission database: parameters of the telescopes, cameras and survey.
    seed : int
        Seed of the request, used for pointing errors and random dithers.
    start : float
        Earliest MJD. An exposure of the sky by Euclid without a date waits until the Sun constraints allow its
        position.

    Yields
    ------
    Exposure
        One exposure with its date.

    Notes
    -----
    BadInput is raised for example if the number of frames is missing, or if the date violates the Sun constraints.
    """
    channels = [registry.CHANNELS[channel] for channel in block.channels]
    bright_sky = block.image_type == "persistence" and block.bright == "sky"
    if bright_sky or any(not channel.on_ground and block.image_type in channel.sky_types for channel in channels):
        if block.mjd is None:
            start = next_allowed(*centre, start, mission)
        check_aspect(*centre, start, mission, "mjd")
    now = start
    for channel in block.channels:
        name = camera if channel == "EXT" else "vis" if channel == "VIS" else "nisp"
        angle = block.position_angle
        if angle is None:
            angle = 0.0 if channel == "EXT" else position_angle(*centre, start)
        template = Exposure(
            channel, name, "", block.image_type, *centre, angle, start, 0.0, "calibration",
            detectors=detectors_of_camera(name, block.detectors, mission),
        )  # fmt: skip
        if block.image_type == "persistence":
            for frame in persistence_darks.exposures(template, block, mission, now):
                yield frame
                now = persistence_darks.persistence_end_mjd(frame, mission)
            continue
        for frame in _frames(template, block, mission, seed):
            yield replace(frame, mjd=now)
            # A NISP exposure is a ramp of reads, which lasts longer than its exposure time. With few groups of many
            # reads, the difference may exceed the pause.
            now += max(frame.exposure_time_s + _PAUSE, elapsed_time(frame, mission)) / _DAY_S


def _frames(template: Exposure, block: Observation, mission: MissionConfiguration, seed: int) -> Iterator[Exposure]:
    band_exposures = [
        replace(template, band=band, exposure_time_s=_seconds(template, band, block, mission))
        for band in lit_flats.select_bands(block.bands, _bands(template, block, mission))
    ]
    if template.image_type == "self_calibration":
        dithers = block.exposures or int(mission.value("survey.self_calibration.dithers"))
        for i, (x, y) in enumerate(_random_offsets(template.camera, dithers, mission, seed)):
            yield from (replace(_shift_pointing(frame, x, y), dither=i + 1) for frame in band_exposures)
    elif template.image_type in TARGETS:
        yield from _target_frames(
            [_with_target_parameters(frame, block) for frame in band_exposures], block, mission, seed
        )
    elif template.image_type == "defocus":
        yield from _defocused_frames(band_exposures, block, mission, seed)
    elif template.image_type == "trap_pumping":
        yield from _pumping_frames(band_exposures[0], block, mission)
    elif not block.exposures:
        raise BadInput(f"image_type {template.image_type} requires exposures, the number of frames")
    elif template.image_type == "flat":
        yield from lit_flats.series(band_exposures, block, mission)
    else:
        for i in range(block.exposures):
            yield band_exposures[i % len(band_exposures)]


def _pumping_frames(frame: Exposure, block: Observation, mission: MissionConfiguration) -> Iterator[Exposure]:
    """Generate trap pumping frames: charge is injected into all rows and shifted back and forth over the traps.

    A phase time is the duration (s) of one clock phase of a shift. `block.exposures` frames are taken for each.

    The default is one frame per phase time. The phase times come from the observation, or else from the mission
    database. Each frame records the duration of the pumping as its exposure time.
    """
    section = image_types.section(frame.camera)
    mission_times = [mission.value(f"{section}.pumping.phase_time_{i + 1}", "s") for i in range(_PHASE_TIMES)]
    for phase in block.phase_times_s or mission_times:
        parameters = ((f"{section}.injection.off", 0.0, "pix"), (f"{section}.pumping.phase_time", phase, "s"))
        seconds = trap_pumping.duration(phase, section, mission)
        for _ in range(block.exposures or 1):
            yield replace(frame, exposure_time_s=seconds, parameters=parameters)


def _defocused_frames(
    band_exposures: Sequence[Exposure], block: Observation, mission: MissionConfiguration, seed: int
) -> Iterator[Exposure]:
    """Generate defocused exposures: at each dither and in each band, one for each wavefront error (nm).

    A wavefront error is the rms defocus with its sign. The errors come from the observation; by default they are minus
    and plus the value in the mission database.
    """
    nominal = mission.value("survey.defocus.wavefront", "nm")
    for frame in _dithered_frames(band_exposures, block, mission, seed):
        key = f"{image_types.section(frame.camera)}.psf.defocus"
        for nm in block.defocus_nm or (-nominal, nominal):
            yield replace(frame, parameters=((key, nm, "nm"),))


def _with_target_parameters(frame: Exposure, block: Observation) -> Exposure:
    """Return the exposure with the parameters of its calibrator that the observation sets; others do not change.

    They are the AB magnitude, and the distance from the boresight in degrees. They replace the values of the mission
    database.
    """
    values = ((getattr(block, attribute), key, unit) for attribute, key, unit in _TARGET_PARAMETERS)
    parameters = tuple(
        (f"survey.{block.image_type}.{key}", value, unit) for value, key, unit in values if value is not None
    )
    return replace(frame, parameters=parameters)


def _seconds(template: Exposure, band: str, block: Observation, mission: MissionConfiguration) -> float:
    if template.image_type in ("bias", "charge_injection", "trap_pumping"):
        return 0.0
    if block.exposure_time_s is not None:
        return block.exposure_time_s
    key = f"{image_types.section(template.camera)}.exposure_time_flat"
    if template.image_type == "flat" and key in mission:
        return mission.value(key, "s")
    return exposure_time(template.channel, template.camera, band, mission)


def _bands(template: Exposure, block: Observation, mission: MissionConfiguration) -> tuple[str, ...]:
    if template.channel == "NISP-P":
        # A dark needs no filter, so that one band stands for all, unless the observation names bands.
        return FILTERS[-1:] if template.image_type == "dark" and not block.bands else FILTERS
    if template.channel == "NISP-S":
        return (RED,)
    return bands_of(template.channel, template.camera, mission)[
        : 1 if template.image_type in ("bias", "dark", "charge_injection", "trap_pumping") else None
    ]


def _target_frames(
    band_exposures: Sequence[Exposure], block: Observation, mission: MissionConfiguration, seed: int
) -> Iterator[Exposure]:
    """Generate dithered exposures of each calibrator that belongs to the image type of `band_exposures`.

    `band_exposures` has one exposure per band; it determines the bands, or the grism, of the generated exposures.
    """
    kind, channel = band_exposures[0].image_type, band_exposures[0].channel
    # A planetary nebula is observed at all grism angles at each dither, a star at one angle per dither.
    settings = N_GRISM_ANGLES if kind == "planetary_nebula" else 1
    for target in TARGETS[kind]:
        for setting in range(settings):
            for frame in _dithered_frames(band_exposures, block, mission, seed):
                exposure = replace(frame, target=target)
                number = setting if settings > 1 else ((frame.dither or 1) - 1) % N_GRISM_ANGLES
                yield _through_grism(exposure, number, mission) if channel == "NISP-S" else exposure


def _dithered_frames(
    band_exposures: Sequence[Exposure], block: Observation, mission: MissionConfiguration, seed: int
) -> Iterator[Exposure]:
    """Generate one exposure in each band at each dither (small displacement of the pointing).

    The number of dithers comes from the observation or the mission database. The displacements follow the dither
    pattern "S" of Euclid, which is repeated after four dithers.
    """
    kind, channel = band_exposures[0].image_type, band_exposures[0].channel
    steps = offsets("S", mission, seed, kind, channel)
    for i in range(block.exposures or int(mission.value(f"survey.{kind}.dithers"))):
        for frame in band_exposures:
            yield replace(_shift_pointing(frame, *steps[i % len(steps)]), dither=i + 1)


def _through_grism(frame: Exposure, number: int, mission: MissionConfiguration) -> Exposure:
    key = f"survey.grism_angle_{number + 1}"
    return through_grism(frame, mission.value(key, "deg"), mission, key)


def _random_offsets(camera: str, dithers: int, mission: MissionConfiguration, seed: int) -> Float:
    """Return random offsets of the telescope along x and y in arcsec, shape (dithers, 2).

    Each offset is uniform between minus and plus half the distance between the centres of neighbouring detectors along
    the same axis.
    """
    fpa = {key: mission.value(f"{camera}.fpa.{key}") for key in ("nx", "ny", "pixel_scale", "gap_x", "gap_y")}
    half = [0.5 * (fpa[f"n{axis}"] * fpa["pixel_scale"] + fpa[f"gap_{axis}"]) for axis in "xy"]
    return rng.stream(seed, "self_calibration", camera).uniform(-1.0, 1.0, (dithers, 2)) * half


def _shift_pointing(frame: Exposure, x: float, y: float) -> Exposure:
    ra, dec = pointing.sky_of_plane([x], [y], frame.ra, frame.dec, frame.position_angle)
    return replace(frame, ra=float(ra[0]), dec=float(dec[0]))
