"""Render the planned exposures: spark-submit jobs/render/render_exposures.py --lake LAKE --request REQUEST."""

import sys
from pathlib import Path

if __name__ == "__main__":
    # spark-submit puts this folder first, where our modules would hide the standard library's.
    sys.path[0] = str(Path(__file__).resolve().parents[2])

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from jobs import heap
from jobs.accuracy import Accuracy
from jobs.fluxes.inputs import library_of, passband_of, stars_of
from jobs.render import (
    edges,
    exposure,
    fits_product,
    focal_plane,
    outskirts,
    own_bodies,
    own_psf,
    pictures,
    selection,
    stamps,
    survey,
)
from jobs.render.exposing import sees_bodies
from jobs.render.plan_exposures import PARTS, mission_of, own_filters
from jobs.request import Request
from jobs.shell import Job, Step, common_facts, main
from lake_schema import layout, parquet, read, reuse, user_files
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.published import read_back
from lake_schema.provenance import canonical, digest, file_sha256
from lake_schema.publish import Json, Output, Part, Plan
from lake_schema.tables.products import PRODUCTS
from lake_schema.tables.rendered_truth import RENDERED_TRUTH

# Each with its fluxes.
CATALOGUES = (("galaxies", "galaxy_fluxes"), ("stars", "star_fluxes"))
INPUTS = ("mission", "exposures", "tasks", "galaxies", "galaxy_fluxes", "stars", "star_fluxes")
# Drawn where the lake has it.
LENSES = "strong_lenses"
# How far beyond a detector sources are looked for that shine so far, arcsec: spikes of stars, outskirts of galaxies.
FARTHEST = max(edges.FARTHEST, outskirts.FARTHEST)
# What the parts of catalogues say of themselves.
_CELLS = "generation_cells"


def steps(lake: Path, request: Request) -> list[Step]:
    """One part a detector of an exposure, the longest first; then what was drawn on each."""
    names = (*INPUTS, LENSES) if layout.current_key(lake, LENSES) else INPUTS
    inputs = {name: read.version(lake, name) for name in names}
    _refuse_other_plan(inputs, request)
    tasks = inputs["tasks"].rows().to_pylist()
    exposures = inputs["exposures"].rows()
    _refuse_unrendered(exposures)
    places = {tuple(task[k] for k in ("ra", "dec", "radius")): task for task in tasks if task["cells"]}
    for name in ("galaxies", "stars"):
        of_task = [selection.needed(task, _deflection(inputs[name])) for task in places.values()]
        _refuse_uncovered(inputs[name], {cell for cells in of_task for cell in cells})
    facts = {
        **common_facts(request, "seed", "accuracy", "mission", "effects", "truth", "compression"),
        "mission": mission_of(request.mission).fingerprint,
        "inputs": {name: version.key for name, version in inputs.items()},
    }
    if psfs := _psf_files(exposures, tasks):
        facts["psf"] = psfs
    if request.bodies is not None:
        facts["bodies"] = _bodies(request.bodies, exposures)
    keys = product_keys(facts, exposures, tasks, inputs, mission_of(request.mission))
    parts = tuple(
        Part(
            f"{task['exposure_id']:06d}-{task['detector'].lower()}.parquet",
            {"exposure_id": task["exposure_id"], "detector": task["detector"], reuse.PRODUCT: key},
        )
        for task, key in zip(tasks, keys, strict=True)
    )
    plan = Plan(PRODUCTS, facts, parts)
    drawn = tuple(Part(part.name, {"part": part.name, reuse.PRODUCT: part.facts[reuse.PRODUCT]}) for part in parts)
    return [Step(plan, work, unit="detector"), Step(Plan(RENDERED_TRUTH, {"products": plan.key}, drawn), truth_work)]


def product_keys(
    facts: Json,
    exposures: pa.Table,
    tasks: Sequence[Json],
    inputs: Mapping[str, read.Version],
    mission: MissionConfiguration,
) -> list[str]:
    """Of each task, the digest of everything that shapes its products, and of nothing else.

    facts : of the plan: request, mission, code
    """
    flux_facts = inputs["galaxy_fluxes"].manifest["facts"]
    shared = {
        **{key: facts[key] for key in ("request", "mission", "code")},
        "library": [flux_facts.get("files"), flux_facts.get("sources")],
    }
    rows = {row["exposure_id"]: row for row in exposures.to_pylist()}
    files = {
        name: (_deflection(inputs[name]), _files_of_cells(inputs[name], inputs[fluxes])) for name, fluxes in CATALOGUES
    }
    if LENSES in inputs:
        files[LENSES] = _deflection(inputs["galaxies"]), _files_of_cells(inputs[LENSES])

    def catalogues(task: Json) -> list[list[tuple[str, ...]]]:
        camera, detector = rows[task["exposure_id"]]["camera"], task["detector"]
        reach = stamps.reach(focal_plane.detector(camera, detector, mission).pixel_scale)
        # Of the cameras VIS alone has spikes, of stars.
        reaches = {name: reach for name in files}
        reaches["galaxies"] = max(FARTHEST, reach)
        if rows[task["exposure_id"]]["channel"] == "VIS":
            reaches["stars"] = max(FARTHEST, reach)
        return [
            sorted({sums for cell in selection.within(task, deflection, reaches[name]) for sums in found.get(cell, ())})
            for name, (deflection, found) in files.items()
        ]

    def own(task: Json) -> Json:
        row, files = rows[task["exposure_id"]], {}
        if psf := row["psf"]:
            files["psf"] = facts["psf"][str(own_psf.file_of(psf, task["detector"]))]
        if "bodies" in facts and sees_bodies(row["channel"], row["image_type"]):
            (files["bodies"],) = facts["bodies"].values()
        return files

    return [
        digest(
            {
                **shared,
                "exposure": rows[task["exposure_id"]],
                "task": {name: task[name] for name in ("detector", "cells", "radius")},
                "catalogues": catalogues(task) if task["cells"] else [],
                **own(task),
            }
        )
        for task in tasks
    ]


def _psf_files(exposures: pa.Table, tasks: Sequence[Json]) -> dict[str, str]:
    """sha256 of the PSFs that the tasks' exposures name, by file."""
    named = dict(zip(exposures["exposure_id"].to_pylist(), exposures["psf"].to_pylist(), strict=True))
    pairs = {(named[task["exposure_id"]], task["detector"]) for task in tasks}
    files = [own_psf.file_of(psf, detector) for psf, detector in pairs if psf]
    return {str(file): file_sha256(user_files.checked(file, "PSF")) for file in files}


def _bodies(file: Path, exposures: pa.Table) -> dict[str, str]:
    """sha256 of the user's moving bodies, by file; refused before anything is rendered where they cannot be read."""
    sha256 = file_sha256(user_files.checked(file, "table of bodies", "solar_system.bodies"))
    kinds = exposures.select(["mjd", "channel", "image_type"]).to_pylist()
    seen = [row["mjd"] for row in kinds if sees_bodies(row["channel"], row["image_type"])]
    own_bodies.check(own_bodies.read(file, sha256), file, seen)
    return {str(file): sha256}


def _files_of_cells(*tables: read.Version) -> Mapping[int, list[tuple[str, ...]]]:
    """Generation cell -> sha256 of the files that hold it, of each of the tables."""
    found: dict[int, list[tuple[str, ...]]] = defaultdict(list)
    for part in tables[0].manifest["parts"]:
        sums = tuple(table.part_sha256(part["name"]) for table in tables)
        for cell in part["facts"][_CELLS]:
            found[cell].append(sums)
    return found


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
    drawn = {"seed": request.seed, **request.facts("universe")["universe"]}
    for name in ("galaxies", "stars"):
        # A catalogue that was not drawn by us has a seed alone.
        for key in ("seed", *(key for key in drawn if key in facts[name])):
            if facts[name].get(key) != drawn[key]:
                values = f"{key} {facts[name].get(key)}, the request {drawn[key]}"
                raise BadInput(f"table {name} has {values}: run build_{name} first, then compute_fluxes")
    if LENSES in inputs and facts[LENSES].get("galaxies") != inputs["galaxies"].key:
        raise BadInput(f"table {LENSES} was drawn in another version of galaxies: run build_strong_lenses first")
    for catalogue, fluxes in CATALOGUES:
        if facts[fluxes].get("input") != inputs[catalogue].key:
            raise BadInput(f"table {fluxes} was computed from another version of {catalogue}: run compute_fluxes first")
        for key, sha256 in filters.get("files", {}).items():
            if facts[fluxes]["files"].get(key) != sha256:
                raise BadInput(f"table {fluxes} was computed with another {key}: run compute_fluxes first")


def _refuse_unrendered(exposures: pa.Table) -> None:
    """Every exposure must be of a kind that has a simulator."""
    for row in exposures.group_by(["channel", "image_type"]).aggregate([([], "count_all")]).to_pylist():
        if row["image_type"] not in exposure.EFFECTS.get(row["channel"], {}):
            kind = f"{row['channel']} {row['image_type']}"
            raise BadInput(
                f"no simulator renders {kind} yet: {row['count_all']} exposures; leave them out of the request"
            )


def _refuse_uncovered(catalogue: read.Version, cells: set[int]) -> None:
    """The detectors must lie where the catalogue was drawn."""
    if missing := sorted(cells - _drawn(catalogue)):
        some = ", ".join(map(str, missing[:3])) + (", ..." if len(missing) > 3 else "")
        wanted = f"{len(missing)} order-{GENERATION_ORDER} cells that the detectors see ({some})"
        first = f"run build_{catalogue.table} over an area that holds all detectors, then compute_fluxes"
        raise BadInput(f"table {catalogue.table} lacks {wanted}: {first}")


def _drawn(catalogue: read.Version) -> set[int]:
    """Order-8 cells that a catalogue was drawn in."""
    return {cell for part in catalogue.manifest["parts"] for cell in part["facts"][_CELLS]}


def _deflection(catalogue: read.Version) -> float:
    """How far a source may be seen from where its cell says, deg; stars are not lensed."""
    return catalogue.deflection() if "ra_lensed" in catalogue.schema.names else 0.0


def sources(
    catalogue: read.Version,
    fluxes: read.Version,
    task: Mapping[str, Any],
    columns: Sequence[str],
    band: str,
    farther: float,
    least: float,
    bright: float = float("inf"),
) -> tuple[pa.Table, pa.Table, float]:
    """(rows of a catalogue that a task may draw, their fluxes, how far beyond the task's circle they are complete).

    farther : how far beyond the circle a source may be seen and reach the detector, arcsec
    least   : microjansky, of sources beyond the cells of the circle; infinite where no source at all shows
    bright  : microjansky, of sources still farther out, as far as spikes and outskirts go; infinite where none do
    """
    deflection, flux = _deflection(catalogue), ["id", f"f_nu_{band}"]
    near: list[int] = []
    far: list[int] = []
    farthest: list[int] = []
    complete = farther
    if np.isfinite(least):
        near = selection.needed(task, deflection)
        far, complete = selection.beyond(task, deflection, farther, _drawn(catalogue))
    if np.isfinite(bright):
        around, _ = selection.beyond(task, deflection, max(FARTHEST, farther), _drawn(catalogue))
        farthest = sorted(set(around) - set(far))
    rows, light = (v.in_cells(near, GENERATION_ORDER, c) for v, c in ((catalogue, columns), (fluxes, flux)))
    for cells, limit in ((far, least), (farthest, bright)):
        if not cells:
            continue
        more, shining = (v.in_cells(cells, GENERATION_ORDER, c) for v, c in ((catalogue, columns), (fluxes, flux)))
        shows = pc.greater_equal(shining[flux[1]], limit)
        rows, light = (pa.concat_tables([a, b.filter(shows)]) for a, b in ((rows, more), (light, shining)))
    return rows, light, complete


def lenses(table: read.Version, task: Mapping[str, Any], deflection: float, least: float) -> pa.Table:
    """Strong lenses that are seen within a task's circle.

    deflection : largest of the galaxies, deg;  least : infinite where no source shows, as in `sources`
    """
    cells = selection.needed(task, deflection) if np.isfinite(least) else []
    about = table.in_cells(cells, GENERATION_ORDER, ["id", "ra_lensed", "dec_lensed"])
    ra, dec = (about[name].to_numpy() for name in ("ra_lensed", "dec_lensed"))
    seen = about["id"].filter(pa.array(selection.near(ra, dec, (task["ra"], task["dec"]), task["radius"])))
    # Pictures are large: only those of lenses that are seen are read.
    parts = [part["name"] for part in table.manifest["parts"] if not set(cells).isdisjoint(part["facts"][_CELLS])]
    return table.rows(pictures.ARC_COLUMNS, parts if len(seen) else [], pc.field("id").isin(seen))


def work(lake: Path, facts: Json) -> Output:
    """One detector: its sources from its own cells, its image, its files."""
    request = facts["request"]
    forced = dict.fromkeys(request["effects"]["on"], True) | dict.fromkeys(request["effects"]["off"], False)
    inputs = {name: read.version(lake, name, key) for name, key in facts["inputs"].items()}
    here = pc.field("exposure_id") == facts["exposure_id"]
    (exposed,) = inputs["exposures"].rows(where=here).to_pylist()
    (task,) = inputs["tasks"].rows(where=here & (pc.field("detector") == facts["detector"])).to_pylist()
    own = survey.variant(exposed["settings"], read_back(inputs["mission"]), Accuracy(**request["accuracy"]), forced)
    detector = focal_plane.detector(exposed["camera"], task["detector"], own.mission)
    if exposed["psf"]:
        file = str(own_psf.file_of(exposed["psf"], task["detector"]))
        if file_sha256(Path(file)) != facts["psf"][file]:
            raise BadInput(f"{file}: has changed since the rendering began")
    bodies = None
    if sees_bodies(exposed["channel"], exposed["image_type"]):
        for file, sha256 in facts.get("bodies", {}).items():
            if file_sha256(Path(file)) != sha256:
                raise BadInput(f"{file}: has changed since the rendering began")
            bodies = own_bodies.read(Path(file), sha256).of_day
    margin = own.mission.value("survey.selection_margin", "arcsec")
    farther = max(stamps.reach(detector.pixel_scale) - margin, 0.0)
    least = exposure.least_flux(exposed, detector, own.mission, own.accuracy)
    band = passband_of(lake, inputs["galaxy_fluxes"].manifest["facts"], str(exposed["band"]))
    spikes = exposure.spike_flux(exposed, detector, own.mission, own.accuracy, band)
    outer = exposure.outer_flux(exposed, detector, own.mission, own.accuracy)
    found = [
        sources(inputs[rows], inputs[fluxes], task, columns, exposed["band"], farther, least, limit)
        for rows, fluxes, columns, limit in (
            ("galaxies", "galaxy_fluxes", exposure.GALAXY_COLUMNS, outer),
            ("stars", "star_fluxes", exposure.STAR_COLUMNS, spikes),
        )
    ]
    with heap.kept():
        rendered = exposure.render(
            task,
            exposed,
            *found[0][:2],
            *found[1][:2],
            mission=own.mission,
            accuracy=own.accuracy,
            seed=request["seed"],
            library=library_of(lake, inputs["galaxy_fluxes"].manifest["facts"]),
            stellar=stars_of(lake, inputs["star_fluxes"].manifest["facts"]),
            passband=band,
            forced=own.forced,
            complete=margin + min(complete for *_, complete in found),
            truth=request["truth"],
            lenses=lenses(inputs[LENSES], task, _deflection(inputs["galaxies"]), least) if LENSES in inputs else None,
            bodies=bodies,
        )
    rows, files = fits_product.products(rendered, request["truth"], request["compression"] == "rice")
    drawn = fits_product.truth(rendered)
    name = truth_file(facts["exposure_id"], facts["detector"])
    return Output(rows, {**files, name: lambda path: parquet.write(path, drawn, RENDERED_TRUTH)})


def truth_work(lake: Path, facts: Json) -> Output:
    """What was drawn on one detector, from beside its images."""
    products = read.version(lake, "products", facts["products"])
    (row, *_) = products.rows(["exposure_id", "detector"], [facts["part"]]).to_pylist()
    return Output(products.beside(truth_file(row["exposure_id"], row["detector"])))


def truth_file(exposure_id: int, detector: str) -> str:
    """Where a version of `products` keeps what was drawn on a detector."""
    return f"truth/{exposure_id:06d}/{detector}.parquet"


JOB = Job("render_exposures", "Render every planned detector to FITS.", steps)

if __name__ == "__main__":
    sys.exit(main(JOB))
