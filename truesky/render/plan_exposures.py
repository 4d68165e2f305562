"""Plan the exposures of a request: spark-submit jobs/render/plan_exposures.py --lake LAKE --request REQUEST."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pyarrow as pa

from lake_schema import command
from lake_schema.errors import BadInput
from lake_schema.mission import checks, published
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.model import read_models
from lake_schema.mission.parameter import read_all_parameters
from lake_schema.store import layout, read
from lake_schema.store.plan import Json, Output, Plan, Task
from lake_schema.store.provenance import digest
from lake_schema.tables.exposures import EXPOSURES
from lake_schema.tables.mission import MISSION
from lake_schema.tables.tasks import TASKS
from truesky.render.channels import registry
from truesky.render.forecasting import forecast, speed
from truesky.render.forecasting.speed import Speed
from truesky.render.planning import ground_surveys, psf_files, source_counts, tasks, variants
from truesky.render.planning.detector_costs import OutputFiles
from truesky.render.planning.exposure_chunks import Chunk, Layout
from truesky.render.planning.mission import PLAN_SECTIONS, mission_of, user_filters
from truesky.render.planning.planned_exposures import Exposure
from truesky.request import universe
from truesky.request.schema import Request
from truesky.request.transients import Transients
from truesky.running.submitted_job import Job, Step, common_facts

# Rows of the table `exposures`, and rows of the table `tasks` (one per detector) for the same exposures.
PlanRows = tuple[pa.Table, pa.Table]
# Key in the recorded inputs of the table `tasks`: its value has the hashes of the tables from which `tasks` was made.
_MADE_OF = "made_of"


@dataclass(frozen=True, slots=True)
class Planner:
    """Make the tables `exposures` and `tasks` (one row per detector of an exposure) of a request.

    The tables are made in chunks (consecutive exposures that one process plans), on the Spark driver or on workers.

    Attributes
    ----------
    lake : Path or None
        Lake (folder of stored tables) whose catalogues give the densities of sources, if it has them.
    request : Request
        The user's request.
    mission : MissionConfiguration
        Mission parameters of the request.
    layout : Layout
        All exposures of the request, divided into chunks; each chunk becomes one partition of each table.
    """

    lake: Path | None
    request: Request
    mission: MissionConfiguration
    layout: Layout

    @classmethod
    def from_request(cls, lake: Path | None, request: Request) -> Planner:
        """Plan the exposures of a request and divide them into chunks (consecutive exposures planned together).

        `lake` is a folder of stored tables, whose catalogues give the densities of sources; None uses number counts.

        Raises BadInput if the request has no pointing or observation, or if one of them or a PSF file is invalid.
        """
        if not request.pointings and not request.observations:
            raise BadInput(f"request {request.name}: nothing to plan, it must have a pointing or an observation")
        mission = mission_of(request.mission)
        checks.check(mission)
        plan_layout = Layout.from_request(request, mission)
        psf_files.check(plan_layout.representative_exposures(), user_filters(request)[0], request.psfs)
        return cls(lake, request, mission, plan_layout)

    def exposures(self, lake: Path, facts: Json) -> Output:
        """Make a partition of the table `exposures`, which has the exposures of one chunk.

        `facts` has the first and last exposure number and MJD of the chunk; {} if there is only one chunk. `lake` is
        not used.
        """
        return Output(self.rows_of_exposures(self.layout.find_chunk(facts)))

    def tasks(self, lake: Path, facts: Json) -> Output:
        """Make a partition of the table `tasks` from the partition of the table `exposures` with the same name.

        `facts` has the first and last exposure number and MJD of the partition, its name, and the version (hash) of the
        table `exposures`. `lake` is the folder in which this table is stored.
        """
        exposures = read.version(lake, EXPOSURES.name, facts[_MADE_OF][EXPOSURES.name])
        chunk = self.layout.find_chunk(facts)
        return Output(self.rows_of_tasks(chunk, exposures.rows(partitions=[facts["part"]])))

    def rows_of_exposures(self, chunk: Chunk) -> pa.Table:
        """Return the rows of the table `exposures` for a chunk (consecutive exposures of the plan)."""
        return self.layout.exposures(chunk, user_filters(self.request)[0], self.request.seed)

    def rows_of_tasks(self, chunk: Chunk, exposures: pa.Table) -> pa.Table:
        """Return the rows of the table `tasks` (one per detector) for a chunk (consecutive exposures of the plan).

        `exposures` are the rows of the table `exposures` for the same chunk.
        """
        request = self.request
        densities = source_counts.Densities(
            self.mission, request.universe, [] if self.lake is None else _catalogues(self.lake, request)
        )
        files = OutputFiles(request.files == "exposure", request.readout)
        detectors, forced = self.layout.requested_detectors(chunk), variants.forced_effects(request)
        rows = tasks.table(
            exposures, detectors, self.mission, densities, request.truth, request.accuracy, forced, files
        )
        days = tasks.persistence_days(exposures, self.mission)
        nearby_exposures = self.layout.exposures_near_in_time(chunk, days) if days else ()
        return tasks.add_persistence_cost(rows, exposures, nearby_exposures, self.mission)

    def tables(self) -> Iterator[PlanRows]:
        """Yield rows of the tables `exposures` and `tasks`: one pair of tables per chunk of consecutive exposures."""
        for chunk in self.layout.chunks:
            exposures = self.rows_of_exposures(chunk)
            yield exposures, self.rows_of_tasks(chunk, exposures)


def plan(lake: Path | None, request: Request) -> tuple[MissionConfiguration, pa.Table, pa.Table]:
    """Return the mission parameters of a request, and all rows of its tables `exposures` and `tasks`.

    `lake` may be a folder of stored tables, whose catalogues give the densities of sources. Without it, or if a
    catalogue is missing, the densities come from number counts.
    """
    planner = Planner.from_request(lake, request)
    return planner.mission, *concatenate(planner.tables())


def concatenate(parts: Iterable[PlanRows]) -> PlanRows:
    """Concatenate the rows of the tables `exposures` and `tasks` of all chunks of a plan (at least one chunk).

    The rows of `tasks` are sorted by estimated CPU time, longest first.
    """
    exposures, rows = zip(*parts, strict=True)
    return pa.concat_tables(exposures).combine_chunks(), tasks.sort_by_cost(pa.concat_tables(rows))


def _catalogues(lake: Path, request: Request) -> list[read.Version]:
    """Return the stored tables `galaxies` and `stars` that a request uses, or [] if the lake lacks one of them."""
    has_all = all(layout.current_link(lake, name).exists() for name in universe.CATALOGUES)
    return [read.input_version(lake, name, request.name) for name in universe.CATALOGUES] if has_all else []


def steps(lake: Path, request: Request) -> list[Step]:
    """Return the steps of this job: one for each of the tables `mission`, `exposures` and `tasks`, in this order.

    After the last step, a forecast of the CPU time, memory and disc space to render the images is printed. The Spark
    driver makes a plan that fits into one partition; workers make larger plans.
    """
    universe.check_catalogues(_catalogues(lake, request), request)
    planner = Planner.from_request(lake, request)
    _warn_of_dates(planner, request)
    facts = {
        **common_facts(request, *PLAN_SECTIONS),
        "mission": planner.mission.fingerprint,
        **user_filters(request)[1],
    }
    mission_facts = {
        "mission": planner.mission.fingerprint,
        "ladder": list(planner.mission.ladder),
        "records": digest([repr(r) for r in (*read_all_parameters(), *read_models())]),
    }
    parts = planner.layout.parts()
    on_driver = len(parts) == 1
    exposures = Plan(EXPOSURES, facts, parts)
    # The CPU times and file sizes in the table `tasks` also depend on the catalogues, and on options of the request
    # that do not change the table `exposures`.
    catalogue_keys = {v.table: v.key for v in _catalogues(lake, request)}
    costs = {**facts, "counts": catalogue_keys, "rendered": request.facts("accuracy", "effects", "files", "readout")}
    costs[_MADE_OF] = {EXPOSURES.name: exposures.key}
    task_parts = tuple(Task(part.name, {**part.facts, "part": part.name}) for part in parts)
    mission_output = published.to_output(planner.mission)
    return [
        Step(
            Plan(MISSION, mission_facts, (Task("all.parquet", {}),)), lambda lake, part: mission_output, on_driver=True
        ),
        Step(exposures, planner.exposures, on_driver=on_driver),
        Step(
            Plan(TASKS, costs, task_parts),
            planner.tasks,
            on_driver=on_driver,
            on_published=partial(_print_published, lake),
        ),
    ]


def _print_published(lake: Path, version: read.Version) -> None:
    """Print a forecast of CPU time, memory and disc space to render all detectors in a stored table `tasks`."""
    exposures = read.version(lake, EXPOSURES.name, version.manifest["facts"][_MADE_OF][EXPOSURES.name])
    columns = ["exposure_id", "survey", "image_type"], ["exposure_id", "detector", "channel", *forecast.SUMMED_COLUMNS]
    _print_forecast(
        lake, ((exposures.rows(columns[0], [part]), version.rows(columns[1], [part])) for part in version.partitions)
    )


def forecast_images(lake: Path, request: Request, parts: Iterable[PlanRows]) -> tuple[list[forecast.Line], Speed]:
    """Forecast CPU time, memory and disc space to render a plan that is not stored in the lake.

    Parameters
    ----------
    lake : Path
        Lake (folder of stored tables), which may have measured times of this machine.
    request : Request
        The user's request.
    parts : iterable of (pyarrow.Table, pyarrow.Table)
        Rows of the tables `exposures` and `tasks` for each chunk of the plan.

    Returns
    -------
    list of Line
        Sums of each kind of image, of each channel, and of everything.
    Speed
        Speed of this machine, to which the CPU times belong.

    Notes
    -----
    Ground exposures with impossible dates cause warnings. BadInput is raised if the catalogues of the lake belong to
    another request.
    """
    universe.check_catalogues(_catalogues(lake, request), request)
    machine = speed.estimate_speed(lake)
    lines = forecast.summarise_chunks(parts, machine.factor)
    _warn_of_dates(Planner.from_request(lake, request), request)
    return lines, machine


def _print_forecast(lake: Path, parts: Iterable[PlanRows]) -> None:
    machine = speed.estimate_speed(lake)
    for line in forecast.format_table(forecast.summarise_chunks(parts, machine.factor), machine):
        print(line)


def _warn_of_dates(planner: Planner, request: Request) -> None:
    exposures = [exposure for exposure, _ in planner.layout.representative_exposures()]
    for line in (
        *ground_surveys.date_warnings(exposures, planner.mission),
        *window_warnings(exposures, request.transients),
    ):
        command.print_error("plan_exposures", line, 0)


def window_warnings(exposures: Sequence[Exposure], window: Transients | None) -> Iterator[str]:
    """Yield a line if exposures of the sky are outside the window of time in which supernovae are drawn.

    `window` is None for a request without supernovae.
    """
    if window is None:
        return
    of_sky = [row for row in exposures if registry.CHANNELS[row.channel].sees_sky(row.image_type)]
    outside = [row for row in of_sky if not window.start <= row.mjd <= window.end]
    if outside:
        number = f"{len(outside)} of {len(of_sky)} exposures of the sky are"
        yield (
            f"universe.transients: {number} outside the window MJD {window.start:g} to {window.end:g}, and lack "
            f"supernovae; for example {outside[0].camera} on MJD {outside[0].mjd:.3f}"
        )


JOB = Job(
    "plan_exposures",
    "Plan which detectors are rendered, with which sky and which sources.",
    steps,
)
