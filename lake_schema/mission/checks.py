"""Check that a mission configuration (one value per parameter of telescope, cameras and survey) is consistent."""

from __future__ import annotations

from collections.abc import Iterator
from fnmatch import fnmatchcase

import numpy as np

from lake_schema.errors import BadInput
from lake_schema.mission import ghost_offsets
from lake_schema.mission.camera_tables import find_overlaps
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.detector_overrides import split_name
from lake_schema.mission.parameter import convert, read_all_parameters
from lake_schema.ramps import MAX_FRAMES, frame_count

# Patterns of the names of parameters whose values must not be higher (_LOWER), or lower (_HIGHER), than required.
_LOWER = ("*.read_noise", "*.dark_current", "*.prnu", "*.crosstalk", "*.jitter_?", "*.psf.fwhm", "*.ellipticity",
          "*.bad_pixels", "*.readout_time", "*.ee50", "*.ee80")  # fmt: skip
_HIGHER = ("*.full_well", "*.quantum_efficiency", "*.resolving_power", "*.depth")
# Patterns of the names of throughput curves that may exceed 1: the curves of Pan-STARRS (camera gpc1) are capture cross
# sections in m2 (Tonry et al. 2012).
_CROSS_SECTIONS = ("ext.gpc1.*",)


def check(configuration: MissionConfiguration) -> None:
    """Raise BadInput with the first fault that `faults` finds in a mission configuration, if there is one."""
    for fault in faults(configuration):
        raise BadInput(fault)


def faults(configuration: MissionConfiguration) -> Iterator[str]:
    """Yield one sentence per fault of a mission configuration; the sentence names the parameter or model (file).

    Values that are worse than required, overlapping detectors, impossible amplifiers, ramps (NISP exposures) with too
    many frames, and throughputs outside 0 to 1 are faults, for example.
    """
    yield from _worse_than_required(configuration)
    for camera in configuration.ground_cameras:
        yield from camera_faults(camera, configuration)
    yield from _amplifier_faults("vis.amplifiers", configuration)
    yield from _gap_faults("vis", configuration)
    yield from _gap_faults("nisp", configuration)
    yield from value_faults(configuration)
    for m in configuration.models:
        if m.key.endswith(".throughput"):
            yield from _throughput_faults(m.key, configuration)
    yield from _quantile_faults("env.cosmic_rays.vis_tracks", configuration)


def camera_faults(camera: str, configuration: MissionConfiguration) -> Iterator[str]:
    """Yield one sentence per fault of a ground camera: detectors that overlap, and amplifiers with impossible values.

    `camera` is the name of the camera in the mission database, such as "decam".
    """
    yield from _layout_faults(f"ext.{camera}", configuration)
    yield from _amplifier_faults(f"ext.{camera}.amplifiers", configuration)


def _worse_than_required(configuration: MissionConfiguration) -> Iterator[str]:
    required = {record.key: record for record in read_all_parameters() if record.status == "REQ"}
    for chosen in configuration.parameters:
        limit = required.get(split_name(chosen.key, configuration)[0])
        if limit is None or chosen.status in ("REQ", "SIM"):
            continue
        bound = convert(limit.value, limit.unit, chosen.unit, chosen.key)
        sign = 1 if _matches_any(chosen.key, _LOWER) else -1 if _matches_any(chosen.key, _HIGHER) else 0
        if sign * (chosen.value - bound) > 0:
            value = f"{chosen.key} ({chosen.status}) = {chosen.value:g}"
            yield f"mission parameter {value} is worse than the required {bound:g}"


def _matches_any(key: str, patterns: tuple[str, ...]) -> bool:
    return any(fnmatchcase(key, pattern) for pattern in patterns)


def _layout_faults(section: str, configuration: MissionConfiguration) -> Iterator[str]:
    """Yield a sentence for each pair of detectors of a camera that overlap, and one if a name occurs twice.

    `section` is the beginning of the names of the camera's parameters, such as "ext.decam". Detectors are taken as
    rectangles along the axes of the focal plane.
    """
    key = f"{section}.layout"
    rows = configuration.rows(key)
    for first, second in find_overlaps(rows, configuration.value(f"{section}.fpa.pixel_size", "mm / pix")):
        yield f"mission model {key}: detectors {rows[first]['detector']} and {rows[second]['detector']} overlap"
    if len({row["detector"] for row in rows}) != len(rows):
        yield f"mission model {key}: a detector is given twice"


def _gap_faults(section: str, configuration: MissionConfiguration) -> Iterator[str]:
    for axis in ("x", "y"):
        if configuration.value(f"{section}.fpa.gap_{axis}", "arcsec") < 0:
            yield f"mission parameter {section}.fpa.gap_{axis}: detectors overlap"


def value_faults(configuration: MissionConfiguration) -> Iterator[str]:
    """Yield one sentence per fault of numbers of a request that are within their bounds, but do not fit together.

    Faults are impossible ramps (exposures of NISP), and ghosts that are displaced out of the focal plane.
    """
    yield from ramp_faults(configuration)
    yield from ghost_offsets.faults(configuration)


def ramp_faults(configuration: MissionConfiguration) -> Iterator[str]:
    """Yield one sentence per fault of NISP's exposures, which are ramps (series of frames read during the exposure).

    Faults are too many frames in a ramp, and a capacitive coupling (IPC) by which the eight neighbours of a pixel
    receive more than half of its charge.
    """
    for kind in ("photometric", "spectroscopic"):
        key = f"nisp.macc.{kind}"
        groups, reads, drops = (int(configuration.value(f"{key}.{part}")) for part in ("groups", "reads", "drops"))
        count = frame_count(groups, reads, drops)
        if count > MAX_FRAMES:
            yield f"mission parameter {key}: MACC({groups},{reads},{drops}) has {count} frames, more than {MAX_FRAMES}"
    coupled_fraction = 4.0 * sum(configuration.value(f"nisp.ipc.{part}") for part in ("side", "diagonal"))
    if coupled_fraction > 0.5:
        yield f"mission parameter nisp.ipc: neighbours receive {coupled_fraction:g} of a pixel's charge, more than 0.5"


def _amplifier_faults(key: str, configuration: MissionConfiguration) -> Iterator[str]:
    for row in configuration.rows(key):
        name = f"mission model {key}: amplifier {row['amplifier']} of {row['type']}"
        if not float(row["gain"]) > 0:
            yield f"{name}: gain = {row['gain']} is not positive"
        if not (float(row["read_noise"]) >= 0 and float(row["full_well"]) > 0):
            yield f"{name}: full well must be positive, and read noise must not be negative"


def _throughput_faults(key: str, configuration: MissionConfiguration) -> Iterator[str]:
    curve = _read_curve(key, configuration)
    if not (np.diff(curve[:, 0]) > 0).all():
        yield f"mission model {key}: wavelengths do not ascend"
    highest = np.inf if _matches_any(key, _CROSS_SECTIONS) else 1.0
    if not ((curve[:, 1] >= 0) & (curve[:, 1] <= highest)).all():
        yield f"mission model {key}: throughput outside 0 to {highest:g}"


def _read_curve(key: str, configuration: MissionConfiguration) -> np.ndarray:
    """Return wavelengths and throughputs, shape (n, 2), of a throughput curve (a model of the mission database).

    The wavelengths of truesky's files are in nm. Files of the library speclite have another format (columns separated
    by blanks, after a header line), and their wavelengths keep their unit.
    """
    text = configuration.content(configuration.model(key)).decode("utf-8")
    header, *lines = (line for line in text.splitlines() if not line.startswith("#"))
    if header.startswith("wavelength_nm"):
        return np.array(configuration.numbers(key))
    # A file of speclite has tens of thousands of lines. `loadtxt` parses them ten times as fast as the module csv.
    return np.loadtxt(lines, usecols=(0, 1), ndmin=2)


def _quantile_faults(key: str, configuration: MissionConfiguration) -> Iterator[str]:
    table = np.array(configuration.numbers(key))
    if table[0, 0] != 0.0 or table[-1, 0] != 1.0:
        yield f"mission model {key}: quantiles do not go from 0 to 1"
    if not (np.diff(table, axis=0) > 0).all():
        yield f"mission model {key}: quantiles do not ascend"
