"""Plan the exposures of a request: spark-submit jobs/render/plan_exposures.py --lake LAKE --request REQUEST."""

import sys
from pathlib import Path

if __name__ == "__main__":
    # spark-submit puts this folder first, where our modules would hide the standard library's.
    sys.path[0] = str(Path(__file__).resolve().parents[2])

from jobs.render import survey
from jobs.request import MissionChoice, Request
from jobs.shell import Job, Step, common_facts, main
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


def mission_of(choice: MissionChoice) -> MissionConfiguration:
    """The mission configuration that a request chooses."""
    overrides = {key: (override.value, override.unit) for key, override in choice.overrides}
    return configuration.resolve(ladder=choice.ladder, overrides=overrides)


def steps(lake: Path, request: Request) -> list[Step]:
    """The mission configuration, the exposures, and a task for each of their detectors."""
    if not request.pointings:
        raise BadInput(f"request {request.name}: pointing is missing: there is nothing to plan")
    mission = mission_of(request.mission)
    checks.check(mission)
    exposures, tasks = survey.plan(request.pointings, mission)
    facts = {**common_facts(request, "pointings"), "mission": mission.fingerprint}
    about = {
        "mission": mission.fingerprint,
        "ladder": list(mission.ladder),
        "records": digest([repr(r) for r in (*read_all(), *read_models())]),
    }
    return [
        _step(MISSION, published.output(mission), about),
        _step(EXPOSURES, Output(exposures), facts),
        _step(TASKS, Output(tasks), facts),
    ]


def _step(table: Table, output: Output, facts: Json) -> Step:
    return Step(Plan(table, facts, (Part("all.parquet", {}),)), lambda lake, part: output, on_driver=True)


JOB = Job("plan_exposures", "Plan which detectors are rendered, with which sky and which sources.", steps)

if __name__ == "__main__":
    sys.exit(main(JOB))
