"""What is refused before anything is rendered: another plan, another universe, an area that was not drawn."""

from collections.abc import Mapping

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema import sky
from lake_schema.arrays import Bool, Float, Int
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.store import read
from lake_schema.store.provenance import canonical
from truesky.render.camera import pointing
from truesky.render.channels import registry
from truesky.render.planning.mission import PARTS, user_filters
from truesky.render.sources import catalogue_rows, selection
from truesky.render.sources.catalogue_rows import CATALOGUES, FARTHEST_MOVED, LENSES
from truesky.request import universe
from truesky.request.area import Area
from truesky.request.schema import Request

# Detectors within so many deg of one another are named one circle; as many circles as a message has room for.
_LINK, _MOST_PATCHES = 5.0, 12

INPUTS = ("mission", "exposures", "tasks", "galaxies", "galaxy_fluxes", "stars", "star_fluxes")


def refuse_other_plan(inputs: Mapping[str, read.Version], request: Request, mission: MissionConfiguration) -> None:
    """What lies in the lake must have been made for this request and its mission, and the tables from one another."""
    universe.refuse_other([inputs[name] for name in universe.CATALOGUES], request)
    facts = {name: version.manifest["facts"] for name, version in inputs.items()}
    filters = user_filters(request)[1]
    wanted = {"request": request.facts(*PARTS), "mission": mission.fingerprint, **filters}
    for name in ("exposures", "tasks"):
        if canonical({key: facts[name].get(key) for key in wanted}) != canonical(wanted):
            raise BadInput(f"table {name} was planned for another request: run plan_exposures first")
    if facts["mission"].get("mission") != wanted["mission"]:
        raise BadInput("table mission was planned for another request: run plan_exposures first")
    if LENSES in inputs and facts[LENSES].get("galaxies") != inputs["galaxies"].key:
        raise BadInput(f"table {LENSES} was drawn in another version of galaxies: run build_strong_lenses first")
    for catalogue, fluxes in CATALOGUES:
        if facts[fluxes].get("input") != inputs[catalogue].key:
            raise BadInput(f"table {fluxes} was computed from another version of {catalogue}: run compute_fluxes first")
        for key, sha256 in filters.get("files", {}).items():
            if facts[fluxes]["files"].get(key) != sha256:
                raise BadInput(f"table {fluxes} was computed with another {key}: run compute_fluxes first")


def rendered(exposures: pa.Table, tasks: pa.Table) -> pa.Table:
    """Those of the tasks whose exposures are of a kind that has a simulator; BadInput where none is."""
    simulated(exposures)
    return drawable(exposures, tasks)


def simulated(exposures: pa.Table) -> pa.Array | None:
    """Numbers of the exposures that are of a kind that has a simulator, None = all are; BadInput where none is."""
    known = _known(exposures)
    if not any(known.values()):
        raise BadInput(f"no simulator renders {', '.join(map(' '.join, known))} yet: nothing to render is planned")
    return _drawn(exposures, known)


def drawable(exposures: pa.Table, tasks: pa.Table) -> pa.Table:
    """As `rendered`, none where none is."""
    wanted = _drawn(exposures, _known(exposures))
    return tasks if wanted is None else tasks.filter(pc.is_in(tasks["exposure_id"], wanted))


def _drawn(exposures: pa.Table, known: Mapping[tuple[str, str], bool]) -> pa.Array | None:
    if all(known.values()):
        return None
    kinds = zip(exposures["channel"].to_pylist(), exposures["image_type"].to_pylist(), strict=True)
    return exposures["exposure_id"].filter(pa.array([known[kind] for kind in kinds], pa.bool_())).combine_chunks()


def _known(exposures: pa.Table) -> dict[tuple[str, str], bool]:
    return {
        (row["channel"], row["image_type"]): registry.effects_or_none(row["channel"], row["image_type"]) is not None
        for row in exposures.group_by(["channel", "image_type"]).aggregate([]).to_pylist()
    }


def refuse_uncovered(catalogue: read.Version, cells: set[int]) -> None:
    """The detectors must lie where the catalogue was drawn."""
    if missing := sorted(cells - catalogue_rows.drawn_cells(catalogue)):
        some = ", ".join(map(str, missing[:3])) + (", ..." if len(missing) > 3 else "")
        wanted = f"{len(missing)} order-{GENERATION_ORDER} cells that the detectors see ({some})"
        first = f"run build_{catalogue.table} over an area that holds all detectors, then compute_fluxes"
        raise BadInput(f"table {catalogue.table} lacks {wanted}: {first}")


# ------------------------------------------------------------------------------------------------ before any catalogue


def refuse_small_area(area: Area, tasks: pa.Table) -> None:
    """All that the tasks' detectors see must lie in the area that catalogues are drawn in.

    The message names an area that would do.
    """
    looks = pc.greater(pc.list_value_length(tasks["cells"]), 0)
    seen = tasks.filter(looks)
    if not seen.num_rows:
        return
    ra, dec, radius = np.unique(np.stack([seen[name].to_numpy() for name in ("ra", "dec", "radius")], axis=1), axis=0).T
    inside = _covers(area, ra, dec, radius)
    if inside.all():
        return
    out = ~inside
    first = seen.filter(pa.array((seen["ra"].to_numpy() == ra[out][0]) & (seen["dec"].to_numpy() == dec[out][0])))
    raise BadInput(
        f"area: {out.sum()} of {out.size} places of detectors see sky outside it, such as {first['channel'][0]} "
        f"{first['detector'][0]} at ra {ra[out][0]:.3f}, dec {dec[out][0]:.3f}; this would do: "
        f"[area] {_would_do(ra, dec, radius)}"
    )


def _covers(area: Area, ra: Float, dec: Float, radius: Float) -> Bool:
    """[n] Whether all order-8 cells in which sources of these circles may lie belong to the area."""
    drawn = set(area.cells())
    # Well inside there is nothing to count; of a box the distance to its edge is no lower bound.
    found = area.depth(ra, dec) > radius + FARTHEST_MOVED if area.box is None else np.zeros(len(ra), bool)
    for i in np.flatnonzero(~found):
        place = {"ra": ra[i], "dec": dec[i], "radius": radius[i]}
        found[i] = drawn.issuperset(selection.needed(place, FARTHEST_MOVED))
    return np.asarray(found)


def _would_do(ra: Float, dec: Float, radius: Float) -> str:
    """A circle that holds all circles; several where they lie far from one another."""
    link, groups = _LINK, _groups(ra, dec, _LINK)
    while len(groups) > _MOST_PATCHES:
        link *= 2.0
        groups = _groups(ra, dec, link)
    circles = [_circle(ra[group], dec[group], radius[group]) for group in groups]
    whole = _circle(ra, dec, radius)
    # Circles that overlap are worth no list of them.
    if sum(size**2 for *_, size in circles) >= whole[2] ** 2:
        return "cone = {{ ra = {:g}, dec = {:g}, radius = {:g} }}".format(*whole)
    return f"patches = [{', '.join('[{:g}, {:g}, {:g}]'.format(*circle) for circle in circles)}]"


def _groups(ra: Float, dec: Float, link: float) -> list[Int]:
    """Places that lie within `link` deg of the first of each group."""
    left, groups = np.arange(len(ra)), []
    while len(left):
        near = sky.separation(ra[left], dec[left], ra[left[0]], dec[left[0]]) <= link
        groups.append(left[near])
        left = left[~near]
    return groups


def _circle(ra: Float, dec: Float, radius: Float) -> tuple[float, float, float]:
    """ra, dec, radius of a circle whose cells hold what is seen from within the circles; rounded to 0.001, 0.01 deg."""
    x, y, z = pointing.basis(ra, dec)[2].mean(axis=1)
    lon = round(float(np.degrees(np.arctan2(y, x))) % 360.0, 3) % 360.0
    lat = round(float(np.degrees(np.arctan2(z, np.hypot(x, y)))), 3)
    reach = float((sky.separation(ra, dec, lon, lat) + radius).max()) + FARTHEST_MOVED
    wanted = min(np.ceil(100.0 * reach) / 100.0, 180.0)
    # Covers hold cells that a circle only nearly touches.
    while wanted < 180.0 and not _covers(Area(ra=lon, dec=lat, radius=wanted), ra, dec, radius).all():
        wanted = min(round(wanted + 0.01, 2), 180.0)
    return lon, lat, float(wanted)
