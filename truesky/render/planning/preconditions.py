"""Check before rendering that plan, catalogues and fluxes match the request, and that the area is large enough."""

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
from truesky.render.planning.mission import PLAN_SECTIONS, user_filters
from truesky.render.sources import catalogue_rows, selection
from truesky.render.sources.catalogue_rows import CATALOGUES, FARTHEST_MOVED, LENSES
from truesky.request import universe
from truesky.request.area import Area
from truesky.request.schema import Request

# Detectors within _LINK deg of one another share one circle; a message lists at most _MAX_PATCHES circles.
_LINK, _MAX_PATCHES = 5.0, 12

INPUTS = ("mission", "exposures", "tasks", "galaxies", "galaxy_fluxes", "stars", "star_fluxes")


def refuse_other_plan(inputs: Mapping[str, read.Version], request: Request, mission: MissionConfiguration) -> None:
    """Check that the plan and the tables were made for this request and its mission, and from one another.

    Parameters
    ----------
    inputs : mapping of str to Version
        Versions of the tables, by table name.
    request : Request
        The request.
    mission : MissionConfiguration
        The mission database of the request.

    Raises
    ------
    BadInput
        If a table belongs to another request, or was made from another version of its input.
    """
    universe.check_catalogues([inputs[name] for name in universe.CATALOGUES], request)
    facts = {name: version.manifest["facts"] for name, version in inputs.items()}
    filters = user_filters(request)[1]
    expected = {"request": request.facts(*PLAN_SECTIONS), "mission": mission.fingerprint, **filters}
    for name in ("exposures", "tasks"):
        if canonical({key: facts[name].get(key) for key in expected}) != canonical(expected):
            raise BadInput(f"table {name} was planned for another request: run plan_exposures first")
    if facts["mission"].get("mission") != expected["mission"]:
        raise BadInput("table mission was planned for another request: run plan_exposures first")
    if LENSES in inputs and facts[LENSES].get("galaxies") != inputs["galaxies"].key:
        raise BadInput(f"table {LENSES} was drawn in another version of galaxies: run build_strong_lenses first")
    for catalogue, fluxes in CATALOGUES:
        if facts[fluxes].get("input") != inputs[catalogue].key:
            raise BadInput(f"table {fluxes} was computed from another version of {catalogue}: run compute_fluxes first")
        for key, sha256 in filters.get("files", {}).items():
            if facts[fluxes]["files"].get(key) != sha256:
                raise BadInput(f"table {fluxes} was computed with another {key}: run compute_fluxes first")


def require_renderable_tasks(exposures: pa.Table, tasks: pa.Table) -> pa.Table:
    """Return the tasks whose exposures have a simulator. Raises BadInput if no exposure has one."""
    renderable_exposures(exposures)
    return renderable_tasks(exposures, tasks)


def renderable_exposures(exposures: pa.Table) -> pa.Array | None:
    """Return the numbers of the exposures that have a simulator, or None if all have one.

    Raises BadInput if no exposure has one.
    """
    has_simulator = _simulator_flags(exposures)
    if not any(has_simulator.values()):
        raise BadInput(
            f"no simulator renders {', '.join(map(' '.join, has_simulator))} yet, and the plan has no other exposures"
        )
    return _renderable_numbers(exposures, has_simulator)


def renderable_tasks(exposures: pa.Table, tasks: pa.Table) -> pa.Table:
    """Return the tasks whose exposures have a simulator; the table may be empty."""
    numbers = _renderable_numbers(exposures, _simulator_flags(exposures))
    return tasks if numbers is None else tasks.filter(pc.is_in(tasks["exposure_id"], numbers))


def _renderable_numbers(exposures: pa.Table, has_simulator: Mapping[tuple[str, str], bool]) -> pa.Array | None:
    if all(has_simulator.values()):
        return None
    channel_types = zip(exposures["channel"].to_pylist(), exposures["image_type"].to_pylist(), strict=True)
    return (
        exposures["exposure_id"]
        .filter(pa.array([has_simulator[kind] for kind in channel_types], pa.bool_()))
        .combine_chunks()
    )


def _simulator_flags(exposures: pa.Table) -> dict[tuple[str, str], bool]:
    return {
        (row["channel"], row["image_type"]): registry.find_effects_or_none(row["channel"], row["image_type"])
        is not None
        for row in exposures.group_by(["channel", "image_type"]).aggregate([]).to_pylist()
    }


def refuse_uncovered(catalogue: read.Version, cells: set[int]) -> None:
    """Raise BadInput if the catalogue does not cover all cells that the detectors observe."""
    if missing := sorted(cells - catalogue_rows.drawn_cells(catalogue)):
        examples = ", ".join(map(str, missing[:3])) + (", ..." if len(missing) > 3 else "")
        missing_cells = f"{len(missing)} order-{GENERATION_ORDER} cells that the detectors observe ({examples})"
        remedy = f"run build_{catalogue.table} over an area that contains all detectors, then compute_fluxes"
        raise BadInput(f"table {catalogue.table} lacks {missing_cells}: {remedy}")


# ------------------------------------------------------------------------------------------------ before any catalogue


def refuse_small_area(area: Area, tasks: pa.Table) -> None:
    """Raise BadInput if detectors of the tasks see sky outside the area of the catalogues.

    The message contains an area that is large enough.
    """
    sees_sky = pc.greater(pc.list_value_length(tasks["cells"]), 0)
    sky_tasks = tasks.filter(sees_sky)
    if not sky_tasks.num_rows:
        return
    ra, dec, radius = np.unique(
        np.stack([sky_tasks[name].to_numpy() for name in ("ra", "dec", "radius")], axis=1), axis=0
    ).T
    inside = _is_covered(area, ra, dec, radius)
    if inside.all():
        return
    outside = ~inside
    first = sky_tasks.filter(
        pa.array((sky_tasks["ra"].to_numpy() == ra[outside][0]) & (sky_tasks["dec"].to_numpy() == dec[outside][0]))
    )
    raise BadInput(
        f"area: {outside.sum()} of {outside.size} detector positions see sky outside it, for example "
        f"{first['channel'][0]} {first['detector'][0]} at ra {ra[outside][0]:.3f}, dec {dec[outside][0]:.3f}; "
        f"this area is large enough: [area] {_sufficient_area(ra, dec, radius)}"
    )


def _is_covered(area: Area, ra: Float, dec: Float, radius: Float) -> Bool:
    """Return for each circle, shape (n), True if the area has all generation cells that may contain its sources."""
    area_cells = set(area.cells())
    # Cells need not be counted well inside the area. For a box, the depth is no lower limit of the distance to the
    # edge.
    covered = area.depth(ra, dec) > radius + FARTHEST_MOVED if area.box is None else np.zeros(len(ra), bool)
    for i in np.flatnonzero(~covered):
        place = {"ra": ra[i], "dec": dec[i], "radius": radius[i]}
        covered[i] = area_cells.issuperset(selection.cells_of_task(place, FARTHEST_MOVED))
    return np.asarray(covered)


def _sufficient_area(ra: Float, dec: Float, radius: Float) -> str:
    """Return an area that contains all circles, as TOML: one circle, or several if the circles are far apart."""
    link, groups = _LINK, _groups(ra, dec, _LINK)
    while len(groups) > _MAX_PATCHES:
        link *= 2.0
        groups = _groups(ra, dec, link)
    circles = [_enclosing_circle(ra[group], dec[group], radius[group]) for group in groups]
    enclosing = _enclosing_circle(ra, dec, radius)
    # A list is pointless if its circles cover more sky than the single circle.
    if sum(size**2 for *_, size in circles) >= enclosing[2] ** 2:
        return "cone = {{ ra = {:g}, dec = {:g}, radius = {:g} }}".format(*enclosing)
    return f"patches = [{', '.join('[{:g}, {:g}, {:g}]'.format(*circle) for circle in circles)}]"


def _groups(ra: Float, dec: Float, link: float) -> list[Int]:
    """Group positions that lie within `link` deg of the first position of each group."""
    remaining, groups = np.arange(len(ra)), []
    while len(remaining):
        in_group = sky.separation(ra[remaining], dec[remaining], ra[remaining[0]], dec[remaining[0]]) <= link
        groups.append(remaining[in_group])
        remaining = remaining[~in_group]
    return groups


def _enclosing_circle(ra: Float, dec: Float, radius: Float) -> tuple[float, float, float]:
    """Return ra, dec and radius (deg) of a circle whose cells contain all sources of the circles.

    The position is rounded to 0.001 deg, the radius up to 0.01 deg.
    """
    x, y, z = pointing.basis(ra, dec)[2].mean(axis=1)
    lon = round(float(np.degrees(np.arctan2(y, x))) % 360.0, 3) % 360.0
    lat = round(float(np.degrees(np.arctan2(z, np.hypot(x, y)))), 3)
    reach = float((sky.separation(ra, dec, lon, lat) + radius).max()) + FARTHEST_MOVED
    circle_radius = min(np.ceil(100.0 * reach) / 100.0, 180.0)
    # The cells of a circle may extend beyond it, so that the circle has to grow until its own cells include them.
    while circle_radius < 180.0 and not _is_covered(Area(ra=lon, dec=lat, radius=circle_radius), ra, dec, radius).all():
        circle_radius = min(round(circle_radius + 0.01, 2), 180.0)
    return lon, lat, float(circle_radius)
