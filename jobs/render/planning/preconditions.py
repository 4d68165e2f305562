"""What is refused before anything is rendered: another plan, another universe, an area that was not drawn."""

from collections.abc import Mapping

import pyarrow as pa

from jobs.render.channels import registry
from jobs.render.planning.mission import PARTS, mission_of, user_filters
from jobs.render.sources import catalogue_rows
from jobs.render.sources.catalogue_rows import CATALOGUES, LENSES
from jobs.request.schema import Request
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import read
from lake_schema.store.provenance import canonical

INPUTS = ("mission", "exposures", "tasks", "galaxies", "galaxy_fluxes", "stars", "star_fluxes")

# What a request says of stars by values alone.
_STAR_KEYS = ("plane_limit", "bright_limit", "density", "brown_dwarf_boost")


def refuse_other_plan(inputs: Mapping[str, read.Version], request: Request) -> None:
    """What lies in the lake must have been made for this request, and the tables from one another."""
    facts = {name: version.manifest["facts"] for name, version in inputs.items()}
    filters = user_filters(request)[1]
    wanted = {"request": request.facts(*PARTS), "mission": mission_of(request.mission).fingerprint, **filters}
    for name in ("exposures", "tasks"):
        if canonical({key: facts[name].get(key) for key in wanted}) != canonical(wanted):
            raise BadInput(f"table {name} was planned for another request: run plan_exposures first")
    if facts["mission"].get("mission") != wanted["mission"]:
        raise BadInput("table mission was planned for another request: run plan_exposures first")
    theirs = None if request.sources is None else request.sources.facts(request.area.bounds())
    for name in ("galaxies", "stars"):
        if canonical(facts[name].get("sources")) != canonical(theirs):
            raise BadInput(f"table {name} has other sources than the request: run build_{name} first")
    drawn = {"seed": request.seed, **request.facts("universe")["universe"]}
    drawn |= {key: request.facts("stars")["stars"][key] for key in _STAR_KEYS}
    for name in ("galaxies", "stars"):
        # A catalogue that was not drawn by us has a seed alone.
        for key in ("seed", *(key for key in drawn if key in facts[name])):
            if canonical(facts[name].get(key)) != canonical(drawn[key]):
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


def refuse_unrendered(exposures: pa.Table) -> None:
    """Every exposure must be of a kind that has a simulator."""
    for row in exposures.group_by(["channel", "image_type"]).aggregate([([], "count_all")]).to_pylist():
        if registry.effects_or_none(row["channel"], row["image_type"]) is None:
            kind = f"{row['channel']} {row['image_type']}"
            raise BadInput(
                f"no simulator renders {kind} yet: {row['count_all']} exposures; leave them out of the request"
            )


def refuse_uncovered(catalogue: read.Version, cells: set[int]) -> None:
    """The detectors must lie where the catalogue was drawn."""
    if missing := sorted(cells - catalogue_rows.drawn_cells(catalogue)):
        some = ", ".join(map(str, missing[:3])) + (", ..." if len(missing) > 3 else "")
        wanted = f"{len(missing)} order-{GENERATION_ORDER} cells that the detectors see ({some})"
        first = f"run build_{catalogue.table} over an area that holds all detectors, then compute_fluxes"
        raise BadInput(f"table {catalogue.table} lacks {wanted}: {first}")
