"""Plan the exposures of a request: spark-submit jobs/render/plan_exposures.py --lake LAKE --request REQUEST."""

import sys
from pathlib import Path

if __name__ == "__main__":
    # spark-submit puts this folder first, where our modules would hide the standard library's.
    sys.path[0] = str(Path(__file__).resolve().parents[2])

from collections.abc import Sequence

import pyarrow as pa

from jobs.fluxes import inputs
from jobs.fluxes.passbands import Passband
from jobs.own_files import OwnCurves
from jobs.render import exposing, forecast, own_psf, speed, survey, tasks
from jobs.request import MissionChoice, Request
from jobs.shell import Job, Step, common_facts, main
from lake_schema import layout, read
from lake_schema.columns import Table
from lake_schema.errors import BadInput
from lake_schema.mission import checks, configuration, published
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.model import read_models
from lake_schema.mission.parameter import read_all
from lake_schema.provenance import digest
from lake_schema.publish import Json, Output, Part, Plan
from lake_schema.tables.exposures import EXPOSURES
from lake_schema.tables.mission import MISSION
from lake_schema.tables.tasks import TASKS

# What of a request decides which exposures are taken and what they cost.
PARTS = ("seed", "area", "universe", "pointings", "observations", "explore", "truth", "psfs")


def mission_of(choice: MissionChoice) -> MissionConfiguration:
    """The mission configuration that a request chooses."""
    overrides = {key: (override.value, override.unit) for key, override in choice.overrides}
    return configuration.resolve(ladder=choice.ladder, overrides=overrides)


def own_filters(request: Request) -> tuple[dict[str, Passband], Json]:
    """The request's own passbands that it points in, by name, and their sha256 as facts of a plan."""
    wanted = {pointing.band for pointing in request.pointings}
    given = OwnCurves(tuple(own for own in request.curves.passbands if own[0] in wanted))
    found, origins = inputs.filters(given)
    for name, band in found.items():
        if band.response.max() > 1.0:
            what = f"responds with {band.response.max():.4g}: a pointing wants the fraction of photons detected"
            raise BadInput(f"{inputs.FILTER}{name}: {what}")
    return found, {"files": {key: origin.sha256 for key, origin in origins.items()}} if found else {}


def plan(lake: Path, request: Request) -> tuple[MissionConfiguration, pa.Table, pa.Table]:
    """The mission configuration, and rows of the tables `exposures` and `tasks`."""
    if not request.pointings and not request.observations:
        raise BadInput(f"request {request.name}: pointing and observation are missing: there is nothing to plan")
    mission = mission_of(request.mission)
    checks.check(mission)
    found = survey.exposures(request, mission)
    filters, _ = own_filters(request)
    exposures = exposing.table([exposure for exposure, _ in found], [own for _, own in found], filters)
    own_psf.check([(exposure, own) for exposure, own in found], filters)
    densities = tasks.Densities(mission, request.universe, _catalogues(lake))
    wanted = [exposure.detectors for exposure, _ in found]
    rows = tasks.table(exposures, wanted, mission, densities, request.truth, request.accuracy, survey.forced(request))
    return mission, exposures, rows


def _catalogues(lake: Path) -> list[read.Version]:
    """The lake's catalogues, if it has them all."""
    names = ("galaxies", "stars")
    return [read.version(lake, name) for name in names] if all(layout.current(lake, n).exists() for n in names) else []


def steps(lake: Path, request: Request) -> list[Step]:
    """The mission configuration, the exposures, and a task for each of their detectors; prints the forecast."""
    mission, exposures, rows = plan(lake, request)
    _print_forecast(lake, exposures, rows)
    facts = {**common_facts(request, *PARTS), "mission": mission.fingerprint, **own_filters(request)[1]}
    # What they cost depends on more than which they are.
    counts = {v.table: v.key for v in _catalogues(lake)}
    costs = {**facts, "counts": counts, "rendered": request.facts("accuracy", "effects")}
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
    """The forecast alone."""
    _, exposures, rows = plan(lake, request)
    _print_forecast(lake, exposures, rows)
    return ()


def _print_forecast(lake: Path, exposures: pa.Table, rows: pa.Table) -> None:
    machine = speed.of_machine(lake)
    for line in forecast.text(forecast.rows(exposures, rows, machine.factor), machine):
        print(line)


JOB = Job(
    "plan_exposures",
    "Plan which detectors are rendered, with which sky and which sources.",
    steps,
    dry_run=dry_run,
)

if __name__ == "__main__":
    sys.exit(main(JOB))
