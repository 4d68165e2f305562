"""Build the table `depth`, the depth and the masks of the planned or rendered exposures of a request.

Command: spark-submit jobs/catalogue/build_depth.py --lake LAKE --request REQUEST.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema import sky
from lake_schema.arrays import Int
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import layout, read
from lake_schema.store.plan import Json, Output, Plan, Task
from lake_schema.store.provenance import code_version, digest
from lake_schema.tables.exposures import ExposureRow
from lake_schema.tables.survey.depth import DEPTH, ORDER
from truesky.catalogue import dust_map
from truesky.render.channels.image_types import shared_settings
from truesky.render.planning.mission import mission_of, user_filters
from truesky.render.planning.variants import mission_lookup
from truesky.request.schema import Request
from truesky.running.submitted_job import Job, Step
from truesky.survey_maps import (
    depth_rows,
    measured_frames,
    planned_footprints,
    satellite_masks,
    star_masks,
    star_places,
)
from truesky.survey_maps.depth_rows import MaskFunction
from truesky.survey_maps.pixel_overlap import PixelGrid
from truesky.survey_maps.planned_footprints import VALUES, Footprints, SurveyModel, air_ranges, sky_images

# HEALPix order of the cells, each of which has one file.
_CELL_ORDER = 5


@dataclass(frozen=True, slots=True)
class DepthMaker:
    """Make partitions (HEALPix cells) of the table `depth` of a request.

    Attributes
    ----------
    request : Request
        The user's request.
    model : SurveyModel
        Settings that determine the depth of exposures.
    """

    request: Request
    model: SurveyModel

    def make_cell(self, lake: Path, facts: Json) -> Output:
        """Make the rows of a cell.

        `facts` has the partition `part`, the keys of the tables `exposures` and `tasks`, and `plan_parts`, the names of
        the partitions of the plan with detectors near the cell.
        """
        order, cell = layout.cell_of_file(facts["part"])
        exposures, tasks = (read.version(lake, name, facts[name]) for name in ("exposures", "tasks"))
        key = facts.get("measured_frames")
        frames = read.version(lake, "measured_frames", key) if key else None
        pieces = [
            planned_footprints.read_part(exposures, tasks, part, self.model, frames).select_near(order, cell)
            for part in facts["plan_parts"]
        ]
        footprints = Footprints(*(np.concatenate(columns) for columns in zip(*pieces, strict=True)))
        grid = PixelGrid.from_cell(order, cell, ORDER)
        dust = dust_map.map_for_request(self.request.seed, self.request.ingest.dust)
        a_v = dust_map.a_v(dust, *sky.cell_centres(ORDER, grid.first_pixel + np.arange(len(grid.centres))))
        rows: dict[int, ExposureRow] = {}
        for part in facts["plan_parts"]:
            rows |= planned_footprints.read_exposures(exposures, part)
        return Output(depth_rows.build(grid, footprints, a_v, self._masks(lake, facts, rows)))

    def _masks(self, lake: Path, facts: Json, rows: Mapping[int, ExposureRow]) -> MaskFunction:
        """Return the function that predicts masks, for exposures by their numbers.

        It predicts the trails of satellites, and the masks of the stars of the lake.
        """
        key = facts.get("star_fluxes")
        fluxes = read.version(lake, "star_fluxes", key) if key else None

        def masks(name: str, footprints: Footprints, grid: PixelGrid) -> Int:
            column = f"f_nu_{name}"
            exposures = {number: rows[number] for number in np.unique(footprints.exposure).tolist()}
            normals = {number: footprints.normals[footprints.exposure == number] for number in exposures}
            settings = self.model.band(name), self.model.mission
            trails = satellite_masks.predict(exposures.values(), normals, self.request, settings, grid)
            if fluxes is None or column not in fluxes.schema.names:
                return trails
            radius = sky.cell_radius(grid.order) + star_masks.REACH
            star_rows = fluxes.cone(*sky.cell_centre(grid.order, grid.cell), radius, ["ra", "dec", column])
            stars = star_places.Stars.from_fluxes(*(star_rows[key].to_numpy() for key in ("ra", "dec", column)))
            time, area = (footprints.values[:, VALUES.index(key)] for key in ("time", "psf_area"))
            missions, first = mission_lookup(self.model.mission), next(iter(exposures.values()))
            psf_area = float(area.sum() / time.sum())
            seen_by = star_places.MaskExposures(
                list(exposures.values()), self.model.band(name), missions(first.settings), psf_area, footprints
            )
            return trails | star_masks.predict(stars, seen_by, grid)

        return masks


def steps(lake: Path, request: Request) -> list[Step]:
    """Plan the making of the table `depth`, with one task per HEALPix cell of order 5 that an exposure touches.

    If the plan has rendered frames, they are measured first, in the table `measured_frames`.

    Parameters
    ----------
    lake : Path
        Folder of the lake, with a plan of the request.
    request : Request
        The request.

    Returns
    -------
    list of Step
        One step, or two if frames of the plan are rendered.

    Raises
    ------
    BadInput
        If the lake has no plan, or the plan has no image of the sky, has a band with two cameras, or explores
        parameters.
    """
    exposures, tasks = (read.input_version(lake, name, request.name) for name in ("exposures", "tasks"))
    all_rows = exposures.rows()
    images = sky_images(all_rows)
    if not images.num_rows:
        raise BadInput(
            f"request {request.name}: its plan has no image of the sky in a passband: the area of a depth map is empty"
        )
    mission, (bands, filter_facts) = mission_of(request.mission), user_filters(request)
    rows = [ExposureRow.from_row(row) for row in images.to_pylist()]
    _require_one_camera(request.name, rows)
    air = air_ranges(rows)
    facts = {
        "exposures": exposures.key,
        "tasks": tasks.key,
        "seed": request.seed,
        "mission": mission.fingerprint,
        **filter_facts,
        **dust_map.facts(request.ingest.dust),
        "images": request.facts("effects", "accuracy", "noise_seed"),
        "code": code_version(),
    }
    # Without stars in the lake, masks have no bits of stars.
    if layout.current_key(lake, "star_fluxes") is not None:
        facts["star_fluxes"] = read.input_version(lake, "star_fluxes", request.name).key
    measuring = _measuring_step(lake, request, facts, images)
    if measuring:
        facts["measured_frames"] = measuring[0].plan.key
    model = SurveyModel(digest(facts), request.seed, mission, bands, air)
    parts_by_cell = _plan_parts(tasks, images["exposure_id"].combine_chunks())
    depth_tasks = tuple(
        Task(name, {"part": name, "plan_parts": parts})
        for name, parts in (
            (layout.cell_file(_CELL_ORDER, cell), parts_by_cell[cell]) for cell in sorted(parts_by_cell)
        )
    )
    return [*measuring, Step(Plan(DEPTH, facts, depth_tasks), DepthMaker(request, model).make_cell, unit="cell")]


def _measuring_step(lake: Path, request: Request, facts: Json, counted: pa.Table) -> list[Step]:
    """Return the step that measures the frames of the counted exposures, or no step without frames."""
    products = measured_frames.find_frames(lake, request.name, facts)
    plan = None if products is None else measured_frames.plan(products, counted)
    if plan is None:
        return []
    return [Step(plan, measured_frames.measure_frame, unit="frame")]


def _require_one_camera(request: str, exposures: Sequence[ExposureRow]) -> None:
    """Raise BadInput if a band has exposures of two cameras, or with two combinations of explored parameters.

    The depth of a pixel in a band is one row, for all exposures together. Exposures that differ in explored parameters
    are alternatives.
    """
    cameras = defaultdict(set)
    for exposure in exposures:
        cameras[exposure.band].add(exposure.camera)
    for band, names in sorted(cameras.items()):
        if len(names) > 1:
            raise BadInput(
                f"request {request}: band {band} is observed by {' and '.join(sorted(names))}, but a depth map has one "
                "camera per band: plan each camera in a separate request"
            )
    variants = {shared_settings(exposure.settings) for exposure in exposures}
    if len(variants) > 1:
        raise BadInput(
            f"request {request}: explores {len(variants)} combinations of parameters, but a depth map has one: plan "
            "without [explore]"
        )


def _plan_parts(tasks: read.Version, counted: pa.Array) -> dict[int, list[str]]:
    """Return the partitions of the plan with detectors near each cell of the sky, by the number of the cell.

    `counted` are the numbers of the images of the sky.
    """
    parts = defaultdict(list)
    for part in tasks.partitions:
        rows = tasks.rows(["exposure_id", "cells"], [part])
        cells = pc.list_flatten(rows.filter(pc.is_in(rows["exposure_id"], counted))["cells"]).to_numpy()
        for cell in np.unique(sky.parent(np.unique(cells), GENERATION_ORDER, _CELL_ORDER)).tolist():
            parts[cell].append(part)
    return parts


JOB = Job("build_depth", "Map the depth and the masks of the planned or rendered exposures.", steps)
