"""Render the planned exposures: spark-submit jobs/render/render_exposures.py --lake LAKE --request REQUEST."""

import sys
from pathlib import Path

if __name__ == "__main__":
    # spark-submit puts this folder first, where our modules would hide the standard library's.
    sys.path[0] = str(Path(__file__).resolve().parents[2])

from collections.abc import Mapping

import pyarrow as pa
import pyarrow.compute as pc

from jobs.accuracy import Accuracy
from jobs.fluxes.inputs import library_of, passband_of, stars_of
from jobs.render import exposure, fits_product, survey
from jobs.render.plan_exposures import PARTS, mission_of, own_filters
from jobs.request import Request
from jobs.shell import Job, Step, common_facts, main
from lake_schema import read
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from lake_schema.mission.published import read_back
from lake_schema.provenance import canonical
from lake_schema.publish import Json, Output, Part, Plan
from lake_schema.tables.products import PRODUCTS

# Image types that are of the sky alone.
IMAGE_TYPES = ("science", "deep")
INPUTS = ("mission", "exposures", "tasks", "galaxies", "galaxy_fluxes", "stars", "star_fluxes")


def steps(lake: Path, request: Request) -> list[Step]:
    """One part a detector of an exposure, the longest first."""
    inputs = {name: read.version(lake, name) for name in INPUTS}
    _refuse_other_plan(inputs, request)
    tasks = inputs["tasks"].rows().to_pylist()
    _refuse_unrendered(inputs["exposures"].rows(["channel", "image_type"]))
    for name in ("galaxies", "stars"):
        _refuse_uncovered(inputs[name], {cell for task in tasks for cell in task["cells"]})
    facts = {
        **common_facts(request, "seed", "accuracy", "mission", "effects", "truth"),
        "mission": mission_of(request.mission).fingerprint,
        "inputs": {name: version.key for name, version in inputs.items()},
    }
    parts = tuple(
        Part(
            f"{task['exposure_id']:06d}-{task['detector'].lower()}.parquet",
            {k: task[k] for k in ("exposure_id", "detector")},
        )
        for task in tasks
    )
    return [Step(Plan(PRODUCTS, facts, parts), work)]


def _refuse_other_plan(inputs: Mapping[str, read.Version], request: Request) -> None:
    """What lies in the lake must have been made for this request, and the tables from one another."""
    facts = {name: version.manifest["facts"] for name, version in inputs.items()}
    filters = own_filters(request)[1]
    wanted = {"request": request.facts(*PARTS), "mission": mission_of(request.mission).fingerprint, **filters}
    for name in ("exposures", "tasks"):
        if canonical({key: facts[name].get(key) for key in wanted}) != canonical(wanted):
            raise BadInput(f"table {name} was planned for another request: run plan_exposures first")
    if facts["mission"].get("mission") != wanted["mission"]:
        raise BadInput("table mission was planned for another request: run plan_exposures first")
    for name in ("galaxies", "stars"):
        if facts[name].get("seed") != request.seed:
            seeds = f"seed {facts[name].get('seed')}, the request {request.seed}"
            raise BadInput(f"table {name} has {seeds}: build it first")
    for fluxes, catalogue in (("galaxy_fluxes", "galaxies"), ("star_fluxes", "stars")):
        if facts[fluxes].get("input") != inputs[catalogue].key:
            raise BadInput(f"table {fluxes} was computed from another version of {catalogue}: run compute_fluxes first")
        for key, sha256 in filters.get("files", {}).items():
            if facts[fluxes]["files"].get(key) != sha256:
                raise BadInput(f"table {fluxes} was computed with another {key}: run compute_fluxes first")


def _refuse_unrendered(exposures: pa.Table) -> None:
    """Every exposure must be of a kind that has a simulator."""
    for row in exposures.group_by(["channel", "image_type"]).aggregate([([], "count_all")]).to_pylist():
        if row["channel"] not in exposure.EFFECTS or row["image_type"] not in IMAGE_TYPES:
            kind = f"{row['channel']} {row['image_type']}"
            raise BadInput(
                f"no simulator renders {kind} yet: {row['count_all']} exposures; leave them out of the request"
            )


def _refuse_uncovered(catalogue: read.Version, cells: set[int]) -> None:
    """The detectors must lie where the catalogue was drawn."""
    drawn = {cell for part in catalogue.manifest["parts"] for cell in part["facts"]["generation_cells"]}
    if missing := sorted(cells - drawn):
        some = ", ".join(map(str, missing[:3])) + (", ..." if len(missing) > 3 else "")
        wanted = f"{len(missing)} order-{GENERATION_ORDER} cells that the detectors see ({some})"
        raise BadInput(f"table {catalogue.table} lacks {wanted}: build it over a larger area first")


def work(lake: Path, facts: Json) -> Output:
    """One detector: its sources from its own cells, its image, its files."""
    request = facts["request"]
    forced = dict.fromkeys(request["effects"]["on"], True) | dict.fromkeys(request["effects"]["off"], False)
    inputs = {name: read.version(lake, name, key) for name, key in facts["inputs"].items()}
    here = pc.field("exposure_id") == facts["exposure_id"]
    (exposed,) = inputs["exposures"].rows(where=here).to_pylist()
    (task,) = inputs["tasks"].rows(where=here & (pc.field("detector") == facts["detector"])).to_pylist()
    flux = ["id", f"f_nu_{exposed['band']}"]
    columns = {
        "galaxies": exposure.GALAXY_COLUMNS,
        "galaxy_fluxes": flux,
        "stars": exposure.STAR_COLUMNS,
        "star_fluxes": flux,
    }
    rows = {name: inputs[name].in_cells(task["cells"], GENERATION_ORDER, wanted) for name, wanted in columns.items()}
    own = survey.variant(exposed["settings"], read_back(inputs["mission"]), Accuracy(**request["accuracy"]), forced)
    rendered = exposure.render(
        task,
        exposed,
        **rows,
        mission=own.mission,
        accuracy=own.accuracy,
        seed=request["seed"],
        library=library_of(lake, inputs["galaxy_fluxes"].manifest["facts"]),
        stellar=stars_of(lake, inputs["star_fluxes"].manifest["facts"]),
        passband=passband_of(lake, inputs["galaxy_fluxes"].manifest["facts"], str(exposed["band"])),
        forced=own.forced,
    )
    return Output(*fits_product.products(rendered, request["truth"]))


JOB = Job("render_exposures", "Render every planned detector to FITS.", steps)

if __name__ == "__main__":
    sys.exit(main(JOB))
