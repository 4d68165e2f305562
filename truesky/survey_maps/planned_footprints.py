"""Read the footprints of detectors in a plan, with the values of each that a depth map sums."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema import sky
from lake_schema.arrays import Array, Bool, Float, Int
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.store import read
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes import passbands
from truesky.fluxes.passbands import Passband
from truesky.render.camera import detectors as camera_detectors
from truesky.render.channels.image_types import SKY_TYPES
from truesky.render.planning.variants import mission_lookup
from truesky.survey_maps import exposure_noise, measured_frames, psf_sizes
from truesky.survey_maps.pixel_overlap import side_normals
from truesky.survey_maps.psf_sizes import AirRange

# Radius of the aperture of the depth in an aperture, arcsec.
APERTURE_RADIUS = 1.0
# Channels with images of the sky in a passband. The depth of slitless spectra depends on the lines of a source.
CHANNELS = ("VIS", "NISP-P", "EXT")
# Values of each footprint that are summed over the exposures of a pixel, in the order of `Footprints.values`.
VALUES = ("time", "sky", "seeing", "psf_area", "point", "aperture", "measured_time")
# Partitions of the plan that a process keeps. One has about 1e5 footprints, which take 20 MB and seconds to read.
_KEPT_PARTS = 8


class Footprints(NamedTuple):
    """Footprints of detectors on the sky, sorted by exposure and detector.

    Attributes
    ----------
    band, camera : object array, shape (n,)
        Names of the passband and of the camera.
    exposure : int64 array, shape (n,)
        Number of the exposure.
    detector : object array, shape (n,)
        Name of the detector.
    centre : float array, shape (n, 3)
        Unit vectors to the centres.
    radius : float array, shape (n,)
        Radius of a circle that contains the footprint, radian.
    normals : float array, shape (n, 4, 3)
        Unit vectors normal to the sides, towards the inside.
    values : float array, shape (n, 7)
        Exposure time t (s); t times the sky (electrons / s / pixel), the FWHM of the PSF (arcsec) and its effective
        area (arcsec^2); inverse variances of the flux of a point source and in the aperture, relative to the flux of AB
        magnitude 0; t if sky and noise were measured on the frame, else 0.
    measured : object array, shape (n,)
        Measurements of the frame, or None.
    """

    band: Array
    camera: Array
    exposure: Int
    detector: Array
    centre: Float
    radius: Float
    normals: Float
    values: Float
    measured: Array

    def select(self, chosen: Bool | Int) -> Footprints:
        """Return the footprints with the given flags or indices."""
        columns: list[Any] = [column[chosen] for column in self]
        return Footprints(*columns)

    def select_near(self, order: int, cell: int) -> Footprints:
        """Return the footprints whose circle touches the circle around a nested HEALPix cell."""
        middle = sky.unit_vectors(*(float(axis) for axis in sky.cell_centre(order, cell)))
        cosine = (self.centre * middle).sum(axis=1)
        reach = self.radius + np.radians(sky.cell_radius(order))
        return self.select(np.flatnonzero(cosine > np.cos(np.minimum(reach, np.pi))))


@dataclass(frozen=True, slots=True)
class SurveyModel:
    """Settings of a request that determine the depth of planned exposures, besides the tables of the plan.

    Attributes
    ----------
    key : str
        Hash of everything below; two models with equal keys are equal.
    seed : int
        Seed of the request.
    mission : MissionConfiguration
        Mission parameters of the request.
    bands : dict of str to Passband
        Passbands of the user, by name.
    air : dict of str to AirRange
        Ranges of seeing and airmass in the whole plan, by `camera:band:settings`, for ground cameras.
    """

    key: str
    seed: int = field(compare=False)
    mission: MissionConfiguration = field(compare=False)
    bands: dict[str, Passband] = field(compare=False)
    air: dict[str, AirRange] = field(compare=False)

    def band(self, name: str) -> Passband:
        """Return a passband of the user or of truesky."""
        return self.bands.get(name) or passbands.load(name)


def sky_images(exposures: pa.Table) -> pa.Table:
    """Return the rows of the table `exposures` that are images of the sky in a passband."""
    kinds = pc.is_in(exposures["image_type"], pa.array(SKY_TYPES))
    return exposures.filter(pc.and_(kinds, pc.is_in(exposures["channel"], pa.array(CHANNELS))))


def air_key(exposure: ExposureRow) -> str:
    """Return the key of an exposure in `SurveyModel.air`."""
    return f"{exposure.camera}:{exposure.band}:{exposure.settings or ''}"


def air_ranges(exposures: Sequence[ExposureRow]) -> dict[str, AirRange]:
    """Return the ranges of seeing and airmass of the exposures of ground cameras without a PSF file, by `air_key`."""
    groups = defaultdict(list)
    for exposure in exposures:
        if exposure.channel == "EXT" and not exposure.psf:
            groups[air_key(exposure)].append(exposure)
    ranges = {}
    for key, group in groups.items():
        seeing, airmass = psf_sizes.air_coordinates(group)
        ranges[key] = AirRange((float(seeing.min()), float(seeing.max())), (float(airmass.min()), float(airmass.max())))
    return ranges


@lru_cache(maxsize=_KEPT_PARTS)
def read_exposures(exposures: read.Version, part: str) -> dict[int, ExposureRow]:
    """Read the exposures in a partition of the plan that count for depth maps.

    Parameters
    ----------
    exposures : Version
        Version of the table `exposures`.
    part : str
        Name of the partition.

    Returns
    -------
    dict of int to ExposureRow
        The exposures by their numbers.
    """
    rows = sky_images(exposures.rows(partitions=[part])).to_pylist()
    return {row["exposure_id"]: ExposureRow.from_row(row) for row in rows}


@lru_cache(maxsize=_KEPT_PARTS)
def read_part(
    exposures: read.Version,
    tasks: read.Version,
    part: str,
    model: SurveyModel,
    frames: read.Version | None = None,
) -> Footprints:
    """Read the footprints in a partition of the plan that count for depth maps.

    Parameters
    ----------
    exposures, tasks : Version
        Versions of the tables of the plan, which have the same partitions.
    part : str
        Name of the partition.
    model : SurveyModel
        Settings that determine the depth.
    frames : Version, optional
        Version of the table `measured_frames`, whose values replace predicted ones.

    Returns
    -------
    Footprints
        The footprints. The last partitions stay in memory, because neighbouring cells of the sky need the same ones.
    """
    rows = read_exposures(exposures, part)
    columns = ["exposure_id", "detector", "ra", "dec", "radius", "s_region"]
    all_tasks = tasks.rows(columns, [part])
    counted_tasks = all_tasks.filter(pc.is_in(all_tasks["exposure_id"], pa.array(rows, pa.int64())))
    counted_tasks = counted_tasks.sort_by([("exposure_id", "ascending"), ("detector", "ascending")])
    exposure_rows = [rows[number] for number in counted_tasks["exposure_id"].to_pylist()]
    names = counted_tasks["detector"].to_pylist()
    pairs = list(zip(counted_tasks["exposure_id"].to_pylist(), names, strict=True))
    noise_of_frames = {} if frames is None else measured_frames.read_measured(frames, pairs)
    measured = np.empty(len(pairs), object)
    measured[:] = [noise_of_frames.get(pair) for pair in pairs]
    return Footprints(
        np.array([e.band for e in exposure_rows], object),
        np.array([e.camera for e in exposure_rows], object),
        counted_tasks["exposure_id"].to_numpy(),
        np.array(names, object),
        sky.unit_vectors(counted_tasks["ra"].to_numpy(), counted_tasks["dec"].to_numpy()),
        np.radians(counted_tasks["radius"].to_numpy()),
        side_normals(_corners(counted_tasks["s_region"])),
        _values(exposure_rows, names, model, measured),
        measured,
    )


def _corners(regions: pa.ChunkedArray) -> Float:
    """Return the corners of footprints, STC-S polygons of four corners, as float[n, 4, 2] in deg."""
    # "POLYGON ICRS" and eight numbers. Arrow reads numbers from texts faster than numpy, with the same bits.
    words = pc.list_flatten(pc.split_pattern(regions, " "))
    numbers = words.filter(pa.array(np.tile(np.arange(10) >= 2, len(regions))))
    return np.asarray(numbers.cast(pa.float64())).reshape(-1, 4, 2)


def _values(exposures: Sequence[ExposureRow], names: Sequence[str], model: SurveyModel, measured: Array) -> Float:
    missions = mission_lookup(model.mission)
    groups = defaultdict(list)
    for i, exposure in enumerate(exposures):
        groups[exposure.camera, exposure.band, exposure.channel, exposure.settings, exposure.psf].append(i)
    values = np.zeros((len(exposures), len(VALUES)))
    for (camera, *_), indices in groups.items():
        group = [exposures[i] for i in indices]
        mission = missions(group[0].settings)
        detectors = {d.name: d for d in camera_detectors.detectors(camera, mission)}
        chosen = [detectors[names[i]] for i in indices]
        level, variance = exposure_noise.variances(group, chosen, mission)
        in_frame = np.array([measured[i] is not None for i in indices])
        for row in np.flatnonzero(in_frame).tolist():
            # The mean of a sky without light may be below 0.
            level[row], variance[row] = max(measured[indices[row]].sky, 0.0), measured[indices[row]].variance
        scale = np.array([d.pixel_scale for d in chosen])
        area, fwhm = _psf_sizes(group, [names[i] for i in indices], model, mission)
        time = np.array([e.exposure_time_s for e in group])
        signal = time * 10.0 ** (0.4 * np.array([e.zero_point for e in group]))
        inverse = signal**2 * scale**2 / variance
        depths = inverse / area, inverse / (np.pi * APERTURE_RADIUS**2)
        columns = (time, time * level, time * fwhm, time * area, *depths, time * in_frame)
        values[indices] = np.stack(columns, axis=1)
    return values


def _psf_sizes(
    group: Sequence[ExposureRow], names: Sequence[str], model: SurveyModel, mission: MissionConfiguration
) -> tuple[Float, Float]:
    band = model.band(group[0].band)
    if air_key(group[0]) in model.air and not group[0].psf:
        unique = list({e.exposure_id: e for e in group}.values())
        places = {e.exposure_id: i for i, e in enumerate(unique)}
        area, fwhm = psf_sizes.in_air(unique, model.air[air_key(group[0])], band, mission)
        row = [places[e.exposure_id] for e in group]
        return area[row], fwhm[row]
    by_detector = psf_sizes.in_field(group[0], band, mission, model.seed)
    both = np.array([by_detector[name] for name in names])
    return both[:, 0], both[:, 1]
