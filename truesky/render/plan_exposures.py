"""Plan the exposures of a request: spark-submit jobs/render/plan_exposures.py --lake LAKE --request REQUEST."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path

import pyarrow as pa

from lake_schema import command
from lake_schema.errors import BadInput
from lake_schema.mission import checks, published
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.model import read_models
from lake_schema.mission.parameter import read_all
from lake_schema.store import layout, read
from lake_schema.store.plan import Json, Output, Part, Plan
from lake_schema.store.provenance import digest
from lake_schema.tables.exposures import EXPOSURES
from lake_schema.tables.mission import MISSION
from lake_schema.tables.tasks import TASKS
from truesky.catalogue import request_checks
from truesky.fluxes import inputs
from truesky.render.forecasting import catalogue_forecast, forecast, speed
from truesky.render.planning import ground_surveys, preconditions, psf_files, source_counts, tasks, variants
from truesky.render.planning.mission import PARTS, mission_of, user_filters
from truesky.render.planning.parts import Layout, Piece
from truesky.render.planning.prices import Files
from truesky.render.products.keys import ephemeris_files, stamp_files
from truesky.request import universe
from truesky.request.checks import check_rendered
from truesky.request.schema import Request
from truesky.running.shell import Job, Step, common_facts

# Rows of `exposures` and of `tasks`.
Plan_ = tuple[pa.Table, pa.Table]
# Fact of the plan of `tasks`: keys of what they were made of.
_MADE_OF = "made_of"


@dataclass(frozen=True, slots=True)
class Planner:
    """What makes the parts of a request's plan, on the driver or on a worker.

    lake : whose catalogues say how dense the sky is, if it has them
    """

    lake: Path | None
    request: Request
    mission: MissionConfiguration
    layout: Layout

    @classmethod
    def of(cls, lake: Path | None, request: Request) -> Planner:
        """Errors : BadInput for whatever is wrong with pointings, observations and PSFs."""
        if not request.pointings and not request.observations:
            raise BadInput(f"request {request.name}: pointing and observation are missing: there is nothing to plan")
        mission = mission_of(request.mission)
        checks.check(mission)
        found = Layout.of(request, mission)
        psf_files.check(found.standing(), user_filters(request)[0], request.psfs)
        return cls(lake, request, mission, found)

    def exposures(self, lake: Path, facts: Json) -> Output:
        """A part of the table `exposures`; facts : its own."""
        return Output(self.rows_of_exposures(self.layout.piece(facts)))

    def tasks(self, lake: Path, facts: Json) -> Output:
        """A part of the table `tasks`; facts : its own, and the key of `exposures`."""
        exposures = read.version(lake, EXPOSURES.name, facts[_MADE_OF][EXPOSURES.name])
        piece = self.layout.piece(facts)
        return Output(self.rows_of_tasks(piece, exposures.rows(parts=[facts["part"]])))

    def rows_of_exposures(self, piece: Piece) -> pa.Table:
        """Rows of the table `exposures` of a part of the layout."""
        return self.layout.exposures(piece, user_filters(self.request)[0], self.request.seed)

    def rows_of_tasks(self, piece: Piece, exposures: pa.Table) -> pa.Table:
        """Rows of the table `tasks` of a part of the layout; exposures : its rows."""
        request = self.request
        densities = source_counts.Densities(
            self.mission, request.universe, [] if self.lake is None else _catalogues(self.lake, request)
        )
        files = Files(request.files == "exposure", request.readout)
        wanted, forced = self.layout.wanted(piece), variants.forced(request)
        rows = tasks.table(exposures, wanted, self.mission, densities, request.truth, request.accuracy, forced, files)
        days = tasks.remembered(exposures, self.mission)
        about = self.layout.about(piece, days) if days else ()
        return tasks.remembering(rows, exposures, about, self.mission)

    def tables(self) -> Iterator[Plan_]:
        """Rows of `exposures` and `tasks`, a part after the other."""
        for piece in self.layout.pieces:
            exposures = self.rows_of_exposures(piece)
            yield exposures, self.rows_of_tasks(piece, exposures)


def plan(lake: Path | None, request: Request) -> tuple[MissionConfiguration, pa.Table, pa.Table]:
    """The mission configuration, and rows of the tables `exposures` and `tasks`; lake : with catalogues, if any."""
    planner = Planner.of(lake, request)
    return planner.mission, *_together(planner.tables())


def _together(parts: Iterable[Plan_]) -> Plan_:
    """Rows of a whole plan, those of tasks longest first."""
    exposures, rows = zip(*parts, strict=True)
    return pa.concat_tables(exposures).combine_chunks(), tasks.in_order(pa.concat_tables(rows))


def _catalogues(lake: Path, request: Request) -> list[read.Version]:
    """The catalogues of the request, if it has them all."""
    there = all(layout.current(lake, name).exists() for name in universe.CATALOGUES)
    return [read.for_request(lake, name, request.name) for name in universe.CATALOGUES] if there else []


def steps(lake: Path, request: Request) -> list[Step]:
    """The mission configuration, the exposures, and a task for each of their detectors; prints the forecast.

    A plan of one part is made on the driver, a larger one by the workers.
    """
    universe.refuse_other(_catalogues(lake, request), request)
    planner = Planner.of(lake, request)
    _say_by_day(planner)
    facts = {**common_facts(request, *PARTS), "mission": planner.mission.fingerprint, **user_filters(request)[1]}
    about = {
        "mission": planner.mission.fingerprint,
        "ladder": list(planner.mission.ladder),
        "records": digest([repr(r) for r in (*read_all(), *read_models())]),
    }
    parts = planner.layout.parts()
    small = len(parts) == 1
    exposures = Plan(EXPOSURES, facts, parts)
    # What they cost depends on more than which they are.
    counts = {v.table: v.key for v in _catalogues(lake, request)}
    costs = {**facts, "counts": counts, "rendered": request.facts("accuracy", "effects", "files", "readout")}
    costs[_MADE_OF] = {EXPOSURES.name: exposures.key}
    own = tuple(Part(part.name, {**part.facts, "part": part.name}) for part in parts)
    whole = published.output(planner.mission)
    return [
        Step(Plan(MISSION, about, (Part("all.parquet", {}),)), lambda lake, part: whole, on_driver=True),
        Step(exposures, planner.exposures, on_driver=small),
        Step(Plan(TASKS, costs, own), planner.tasks, on_driver=small, after=partial(_print_published, lake)),
    ]


def _print_published(lake: Path, version: read.Version) -> None:
    """The forecast of published tasks."""
    exposures = read.version(lake, EXPOSURES.name, version.manifest["facts"][_MADE_OF][EXPOSURES.name])
    columns = ["exposure_id", "survey", "image_type"], ["exposure_id", "detector", "channel", *forecast.SUMMED]
    _print_forecast(
        lake, ((exposures.rows(columns[0], [part]), version.rows(columns[1], [part])) for part in version.parts)
    )


def dry_run(lake: Path, request: Request) -> Sequence[Step]:
    """The forecast alone, of the catalogues, too, of a request that no later job would refuse."""
    universe.refuse_other(_catalogues(lake, request), request)
    _print_forecast(lake, checked(request, lake))
    _say_by_day(Planner.of(lake, request))
    print()
    for line in catalogue_forecast.text(catalogue_forecast.of_request(request, speed.of_machine(lake).factor)):
        print(line)
    return ()


def check(request: Request, lake: Path | None = None) -> Plan_:
    """Refuse whatever the jobs of this request would refuse, the catalogues' as well, before any of them runs.

    returns : rows of the tables `exposures` and `tasks`, as planned;  lake : whose catalogues say how dense the sky is
    """
    return _together(checked(request, lake))


def checked(request: Request, lake: Path | None = None) -> Iterator[Plan_]:
    """As `check`, a part of the plan after the other; all is refused that is to be when the last has come."""
    check_rendered(request)
    # First what names the pointing or the observation that is wrong.
    planner = Planner.of(lake, request)
    parts = planner.tables()
    first = next(parts)
    check_catalogues(request)
    if request.structure.stamps is not None:
        stamp_files(request.structure.stamps.file)
    narrowed, some = tasks.Narrowed(request), False
    for exposures, rows in chain([first], parts):
        if request.bodies is not None:
            ephemeris_files(request.bodies, exposures)
        seen = preconditions.drawable(exposures, rows)
        some = some or seen.num_rows > 0
        preconditions.refuse_small_area(request.area, narrowed.of(seen))
        yield exposures, rows
    if not some:
        preconditions.rendered(exposures, rows)
    narrowed.refuse_unknown()


def check_catalogues(request: Request) -> None:
    """Refuse whatever the jobs of catalogues and fluxes would refuse."""
    inputs.curves(request.bands, inputs.read(request.curves).passbands)
    request_checks.refuse(request)


def _print_forecast(lake: Path, parts: Iterable[Plan_]) -> None:
    machine = speed.of_machine(lake)
    for line in forecast.text(forecast.of_parts(parts, machine.factor), machine):
        print(line)


def _say_by_day(planner: Planner) -> None:
    if line := ground_surveys.by_day((exposure for exposure, _ in planner.layout.standing()), planner.mission):
        command.say("plan_exposures", line, 0)


JOB = Job(
    "plan_exposures",
    "Plan which detectors are rendered, with which sky and which sources.",
    steps,
    dry_run=dry_run,
)
