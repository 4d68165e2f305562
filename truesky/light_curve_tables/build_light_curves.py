"""Build the table `light_curves`, the fluxes of the sources that change in the planned exposures of a request.

Command: spark-submit jobs/catalogue/build_light_curves.py --lake LAKE --request REQUEST.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.store import read
from lake_schema.store.plan import Json, Output, Plan, Task
from lake_schema.store.provenance import code_version
from lake_schema.tables.exposures import ExposureRow
from lake_schema.tables.variability.light_curves import LIGHT_CURVES
from truesky.fluxes.inputs import passband_from_facts
from truesky.light_curve_tables import changing_sources
from truesky.render import product_plan
from truesky.render.camera import detectors
from truesky.render.channels.aim import Aim
from truesky.render.planning import preconditions
from truesky.render.planning.mission import mission_of
from truesky.render.planning.variants import mission_lookup
from truesky.request.schema import Request
from truesky.running.submitted_job import Job, Step
from truesky.survey_maps.planned_footprints import sky_images

# Largest number of detectors in a block of exposures, which becomes one file; a single exposure may have more. Ten
# exposures of LSST make half a million rows at most.
_MAX_DETECTORS = 2000
_TASK_COLUMNS = ("exposure_id", "detector", "ra", "dec", "radius")


@dataclass(frozen=True, slots=True)
class LightCurveMaker:
    """Make partitions (blocks of exposures) of the table `light_curves` of a request.

    Attributes
    ----------
    seed : int
        Seed of the request.
    mission : MissionConfiguration
        Mission parameters of the request.
    """

    seed: int
    mission: MissionConfiguration

    def make_block(self, lake: Path, facts: Json) -> Output:
        """Make the rows of a block of exposures.

        Parameters
        ----------
        lake : Path
            Folder of the lake.
        facts : dict
            Parameters of the job and of the task: `inputs`, the versions of the tables; `plan_part`, the name of the
            partition of the plan; and `exposures`, the first and the last number of the block.

        Returns
        -------
        Output
            The rows, sorted by exposure, detector and identifier.
        """
        versions = {name: read.version(lake, name, key) for name, key in facts["inputs"].items()}
        first, last = facts["exposures"]
        in_block = (pc.field("exposure_id") >= first) & (pc.field("exposure_id") <= last)
        planned = {}
        for row in sky_images(versions["exposures"].rows(partitions=[facts["plan_part"]], where=in_block)).to_pylist():
            planned[row["exposure_id"]] = ExposureRow.from_row(row)
        tasks = versions["tasks"].rows(_TASK_COLUMNS, [facts["plan_part"]], in_block)
        tasks = tasks.sort_by([("exposure_id", "ascending"), ("detector", "ascending")])
        pieces = [LIGHT_CURVES.empty()]
        for number, group in groupby(tasks.to_pylist(), lambda task: task["exposure_id"]):
            if number in planned:
                pieces += self._exposure_rows(lake, versions, planned[number], list(group))
        return Output(pa.concat_tables(pieces).combine_chunks())

    def _exposure_rows(
        self, lake: Path, versions: dict[str, read.Version], exposed: ExposureRow, tasks: list[dict[str, Any]]
    ) -> Iterator[pa.Table]:
        """Yield the rows of each detector of an exposure, given its rows of the table `tasks`."""
        sources = changing_sources.read_sources(versions, changing_sources.circle_around(tasks), exposed)
        mission = mission_lookup(self.mission)(exposed.settings)
        by_name = {detector.name: detector for detector in detectors.detectors(exposed.camera, mission)}
        band = passband_from_facts(lake, versions["galaxy_fluxes"].manifest["facts"], exposed.band)
        for task in tasks:
            aim = Aim.from_exposure(exposed, by_name[task["detector"]], band, self.seed)
            yield changing_sources.light_on_detector(sources, aim)


def steps(lake: Path, request: Request) -> list[Step]:
    """Plan the making of the table `light_curves`, with one task per block of exposures.

    Parameters
    ----------
    lake : Path
        Folder of the lake, with the catalogues, their fluxes and a plan of the request.
    request : Request
        The request.

    Returns
    -------
    list of Step
        One step.

    Raises
    ------
    BadInput
        If the request has no exposures or no sources that change, a table is missing or was made for another request,
        or no exposure is an image of the sky.
    """
    if not request.pointings and not request.observations:
        raise BadInput(
            f"request {request.name}: it has no exposures for light curves: add a [[pointing]] or an [[observation]]"
        )
    if request.transients is None and not request.universe.variables:
        raise BadInput(f"request {request.name}: no source changes: set universe.transients or universe.variables")
    mission, versions = mission_of(request.mission), product_plan.input_versions(lake, request)
    preconditions.refuse_other_plan(versions, request, mission)
    tasks = tuple(_blocks(versions["exposures"], versions["tasks"]))
    if not tasks:
        raise BadInput(f"request {request.name}: its plan has no image of the sky in a passband for light curves")
    facts = {
        "seed": request.seed,
        "mission": mission.fingerprint,
        "inputs": {name: version.key for name, version in versions.items()},
        "code": code_version(),
    }
    return [Step(Plan(LIGHT_CURVES, facts, tasks), LightCurveMaker(request.seed, mission).make_block, unit="block")]


def _blocks(exposures: read.Version, tasks: read.Version) -> Iterator[Task]:
    """Yield the tasks of the table: blocks of the images of the sky in each partition of the plan."""
    columns = ["exposure_id", "image_type", "channel"]
    for part in tasks.partitions:
        images = sky_images(exposures.rows(columns, [part]))["exposure_id"]
        counted = tasks.rows(["exposure_id"], [part])
        counts = counted.filter(pc.is_in(counted["exposure_id"], images.combine_chunks())).group_by("exposure_id")
        numbers = counts.aggregate([([], "count_all")]).sort_by("exposure_id")
        block: list[int] = []
        size = 0
        for number, count in zip(numbers["exposure_id"].to_pylist(), numbers["count_all"].to_pylist(), strict=True):
            if block and size + count > _MAX_DETECTORS:
                yield _block_task(part, block)
                block, size = [], 0
            block.append(number)
            size += count
        if block:
            yield _block_task(part, block)


def _block_task(part: str, numbers: list[int]) -> Task:
    return Task(f"{numbers[0]:09d}.parquet", {"plan_part": part, "exposures": [numbers[0], numbers[-1]]})


JOB = Job("build_light_curves", "Compute the fluxes of sources that change in the planned exposures.", steps)
