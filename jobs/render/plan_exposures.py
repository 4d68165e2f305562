"""Plan the exposures of a request: spark-submit jobs/render/plan_exposures.py --lake LAKE --request REQUEST."""

import sys
from pathlib import Path

if __name__ == "__main__":
    # spark-submit puts this folder first, where our modules would hide the standard library's.
    sys.path[0] = str(Path(__file__).resolve().parents[2])

from collections.abc import Sequence

import pyarrow as pa

from jobs.catalogue import request_checks
from jobs.fluxes import inputs
from jobs.render.forecasting import catalogue_forecast, forecast, speed
from jobs.render.planning import (
    ground_surveys,
    planned_exposures,
    preconditions,
    psf_files,
    source_counts,
    survey,
    tasks,
    variants,
)
from jobs.render.planning.mission import PARTS, mission_of, user_filters
from jobs.render.planning.prices import Files
from jobs.render.products.keys import ephemeris_files, stamp_files
from jobs.request import universe
from jobs.request.checks import check_rendered
from jobs.request.schema import Request
from jobs.shell import Job, Step, common_facts, main
from lake_schema import command
from lake_schema.columns import Table
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


def plan(lake: Path | None, request: Request) -> tuple[MissionConfiguration, pa.Table, pa.Table]:
    """The mission configuration, and rows of the tables `exposures` and `tasks`; lake : with catalogues, if any."""
    if not request.pointings and not request.observations:
        raise BadInput(f"request {request.name}: pointing and observation are missing: there is nothing to plan")
    mission = mission_of(request.mission)
    checks.check(mission)
    found = survey.exposures(request, mission)
    filters, _ = user_filters(request)
    missions = [own for _, own in found]
    exposures = planned_exposures.table([exposure for exposure, _ in found], missions, filters, request.seed)
    psf_files.check([(exposure, own) for exposure, own in found], filters)
    catalogues = [] if lake is None else _catalogues(lake, request)
    densities = source_counts.Densities(mission, request.universe, catalogues)
    wanted = [exposure.detectors for exposure, _ in found]
    forced, files = variants.forced(request), Files(request.files == "exposure", request.readout)
    rows = tasks.table(exposures, wanted, mission, densities, request.truth, request.accuracy, forced, files)
    return mission, exposures, rows


def _catalogues(lake: Path, request: Request) -> list[read.Version]:
    """The catalogues of the request, if it has them all."""
    there = all(layout.current(lake, name).exists() for name in universe.CATALOGUES)
    return [read.for_request(lake, name, request.name) for name in universe.CATALOGUES] if there else []


def steps(lake: Path, request: Request) -> list[Step]:
    """The mission configuration, the exposures, and a task for each of their detectors; prints the forecast."""
    universe.refuse_other(_catalogues(lake, request), request)
    mission, exposures, rows = plan(lake, request)
    _print_forecast(lake, exposures, rows)
    _say_by_day(exposures, mission)
    facts = {**common_facts(request, *PARTS), "mission": mission.fingerprint, **user_filters(request)[1]}
    # What they cost depends on more than which they are.
    counts = {v.table: v.key for v in _catalogues(lake, request)}
    costs = {**facts, "counts": counts, "rendered": request.facts("accuracy", "effects", "files", "readout")}
    about = {
        "mission": mission.fingerprint,
        "ladder": list(mission.ladder),
        "records": digest([repr(r) for r in (*read_all(), *read_models())]),
    }
    return [
        _step(MISSION, published.output(mission), about),
        _step(EXPOSURES, Output(exposures), facts),
        _step(TASKS, Output(rows), costs),
    ]


def _step(table: Table, output: Output, facts: Json) -> Step:
    return Step(Plan(table, facts, (Part("all.parquet", {}),)), lambda lake, part: output, on_driver=True)


def dry_run(lake: Path, request: Request) -> Sequence[Step]:
    """The forecast alone, of the catalogues, too, of a request that no later job would refuse."""
    universe.refuse_other(_catalogues(lake, request), request)
    exposures, rows = check(request, lake)
    _print_forecast(lake, exposures, rows)
    _say_by_day(exposures, mission_of(request.mission))
    print()
    for line in catalogue_forecast.text(catalogue_forecast.of_request(request, speed.of_machine(lake).factor)):
        print(line)
    return ()


def check(request: Request, lake: Path | None = None) -> tuple[pa.Table, pa.Table]:
    """Refuse whatever the jobs of this request would refuse, the catalogues' as well, before any of them runs.

    returns : rows of the tables `exposures` and `tasks`, as planned;  lake : whose catalogues say how dense the sky is
    """
    check_rendered(request)
    # First what names the pointing or the observation that is wrong.
    _, exposures, rows = plan(lake, request)
    check_catalogues(request)
    if request.bodies is not None:
        ephemeris_files(request.bodies, exposures)
    if request.structure.stamps is not None:
        stamp_files(request.structure.stamps.file)
    seen = preconditions.rendered(exposures, rows)
    if request.detectors or request.limit is not None:
        seen = pa.Table.from_pylist(tasks.part(seen, request), seen.schema)
    preconditions.refuse_small_area(request.area, seen)
    return exposures, rows


def check_catalogues(request: Request) -> None:
    """Refuse whatever the jobs of catalogues and fluxes would refuse."""
    inputs.curves(request.bands, inputs.read(request.curves).passbands)
    request_checks.refuse(request)


def _print_forecast(lake: Path, exposures: pa.Table, rows: pa.Table) -> None:
    machine = speed.of_machine(lake)
    for line in forecast.text(forecast.rows(exposures, rows, machine.factor), machine):
        print(line)


def _say_by_day(exposures: pa.Table, mission: MissionConfiguration) -> None:
    if line := ground_surveys.by_day(exposures, mission):
        command.say("plan_exposures", line, 0)


JOB = Job(
    "plan_exposures",
    "Plan which detectors are rendered, with which sky and which sources.",
    steps,
    dry_run=dry_run,
)

if __name__ == "__main__":
    sys.exit(main(JOB))
