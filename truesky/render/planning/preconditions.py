"""Check before rendering that the stored tables match the request, and that the catalogues cover all detectors."""

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
from lake_schema.store.plan import Json
from lake_schema.store.provenance import canonical
from truesky.render.camera import pointing
from truesky.render.channels import registry
from truesky.render.planning.mission import PLAN_SECTIONS, user_filters
from truesky.render.sources import catalogue_rows, selection
from truesky.render.sources.catalogue_rows import CATALOGUES, FARTHEST_MOVED, LENSES
from truesky.render.sources.nuclei import ACTIVE_NUCLEI
from truesky.render.sources.transients import LENSED_IMAGES, TRANSIENTS
from truesky.request import universe
from truesky.request.area import Area
from truesky.request.schema import Request
from truesky.variability import spectral_series

# If the area of a request is too small, the error message suggests circles on the sky that contain all detectors.
# Detectors within this distance (deg) share a circle.
_LINK = 5.0
# Largest number of circles on the sky that the error message suggests instead of an area that is too small. If there
# are more circles, detectors at larger distances share a circle.
_MAX_PATCHES = 12

# Tables of the lake from which images are rendered.
INPUTS = ("mission", "exposures", "tasks", "galaxies", "galaxy_fluxes", "stars", "star_fluxes")


def refuse_other_plan(inputs: Mapping[str, read.Version], request: Request, mission: MissionConfiguration) -> None:
    """Check that the stored tables were made for this request and these mission parameters, and fit one another.

    Parameters
    ----------
    inputs : mapping of str to Version
        Stored versions of the tables `INPUTS`, and of `strong_lenses` if it exists, by table name.
    request : Request
        The user's request.
    mission : MissionConfiguration
        Mission parameters of the request.

    Raises
    ------
    BadInput
        If a table was made for another request or other mission parameters. Also if fluxes or lenses were computed from
        another version of the catalogue, or fluxes with other passbands. The message names the command to run.
    """
    universe.check_catalogues([inputs[name] for name in universe.CATALOGUES], request)
    facts = {name: version.manifest["facts"] for name, version in inputs.items()}
    filters = user_filters(request)[1]
    expected = {"request": request.facts(*PLAN_SECTIONS), "mission": mission.fingerprint, **filters}
    for name in ("exposures", "tasks"):
        if canonical({key: facts[name].get(key) for key in expected}) != canonical(expected):
            raise BadInput(f"table {name} was planned for another request: run truesky plan first")
    if facts["mission"].get("mission") != expected["mission"]:
        raise BadInput("table mission was planned for another request: run truesky plan first")
    if LENSES in inputs and facts[LENSES].get("galaxies") != inputs["galaxies"].key:
        raise BadInput(f"table {LENSES} was drawn in another version of galaxies: run truesky lenses first")
    if ACTIVE_NUCLEI in inputs and facts[ACTIVE_NUCLEI].get("galaxies") != inputs["galaxies"].key:
        raise BadInput(f"table {ACTIVE_NUCLEI} was drawn in another version of galaxies: run truesky nuclei first")
    if LENSED_IMAGES in inputs:
        for name in (LENSES, TRANSIENTS):
            if facts[LENSED_IMAGES].get(name) != (inputs[name].key if name in inputs else None):
                raise BadInput(f"table {LENSED_IMAGES} was made with another {name}: run truesky lensed first")
    if TRANSIENTS in inputs:
        _refuse_other_transients(facts[TRANSIENTS], inputs["galaxies"].key, request)
    for catalogue, fluxes in CATALOGUES:
        if facts[fluxes].get("input") != inputs[catalogue].key:
            raise BadInput(f"table {fluxes} was computed from another version of {catalogue}: run truesky fluxes first")
        for key, sha256 in filters.get("files", {}).items():
            if facts[fluxes]["files"].get(key) != sha256:
                raise BadInput(f"table {fluxes} was computed with another {key}: run truesky fluxes first")


def _refuse_other_transients(facts: Json, galaxies: str, request: Request) -> None:
    """Raise BadInput if the table `transients` was drawn in other galaxies, or for another window of time."""
    settings = request.transients
    assert settings is not None
    expected: dict[str, object] = {
        "galaxies": galaxies, "start": settings.start, "end": settings.end, "boost": settings.boost,
        "kinds": list(settings.kinds),
    }  # fmt: skip
    expected |= spectral_series.facts(settings.light_curves) or {"light_curves": None}
    for key, value in expected.items():
        if canonical(facts.get(key)) != canonical(value):
            raise BadInput(f"table {TRANSIENTS} was drawn with another {key}: run truesky transients first")


def require_renderable_tasks(exposures: pa.Table, tasks: pa.Table) -> pa.Table:
    """Return the rows of `tasks` (one per detector of an exposure) whose image type truesky can render.

    Raises BadInput if it can render none of the exposures.
    """
    renderable_exposures(exposures)
    return renderable_tasks(exposures, tasks)


def renderable_exposures(exposures: pa.Table) -> pa.Array | None:
    """Return the numbers of the exposures that truesky can render, or None if it can render every exposure.

    Some image types of a channel can only be planned. Raises BadInput if none of the exposures can be rendered.
    """
    has_simulator = _simulator_flags(exposures)
    if not any(has_simulator.values()):
        raise BadInput(
            f"no simulator renders {', '.join(map(' '.join, has_simulator))} yet, and the plan has no other exposures"
        )
    return _renderable_numbers(exposures, has_simulator)


def renderable_tasks(exposures: pa.Table, tasks: pa.Table) -> pa.Table:
    """Return the rows of `tasks` (one per detector of an exposure) whose image type truesky can render.

    The result is empty if it can render none.
    """
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
    """Raise BadInput if a catalogue lacks some of the order-8 HEALPix cells that the detectors observe."""
    if missing := sorted(cells - catalogue_rows.drawn_cells(catalogue)):
        examples = ", ".join(map(str, missing[:3])) + (", ..." if len(missing) > 3 else "")
        missing_cells = f"{len(missing)} order-{GENERATION_ORDER} cells that the detectors observe ({examples})"
        remedy = "run truesky build over an area that contains all detectors, then truesky fluxes"
        raise BadInput(f"table {catalogue.table} lacks {missing_cells}: {remedy}")


def refuse_small_area(area: Area, tasks: pa.Table) -> None:
    """Raise BadInput if detectors see sky outside the area for which the request simulates catalogues.

    `tasks` has one row per detector of an exposure; rows without sky cells are ignored. The message contains an area
    that is large enough.
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
        f"this area is large enough: area.{_sufficient_area(ra, dec, radius)}"
    )


def _is_covered(area: Area, ra: Float, dec: Float, radius: Float) -> Bool:
    """Return for each circle on the sky whether the area has all order-8 cells that may contain its sources; bool[n].

    Positions and radii are in degrees. The circles are enlarged for stars that have moved since the catalogue's epoch.
    """
    area_cells = set(area.cells())
    # The cells of a circle well inside the area need not be searched. For a box this shortcut is wrong: `depth`
    # (distance from the edge of the area) may exceed the true distance.
    covered = area.depth(ra, dec) > radius + FARTHEST_MOVED if area.box is None else np.zeros(len(ra), bool)
    for i in np.flatnonzero(~covered):
        place = {"ra": ra[i], "dec": dec[i], "radius": radius[i]}
        covered[i] = area_cells.issuperset(selection.cells_of_task(place, FARTHEST_MOVED))
    return np.asarray(covered)


def _sufficient_area(ra: Float, dec: Float, radius: Float) -> str:
    """Return the TOML text of an area of the sky that contains all given circles (ra, dec, radius in degrees).

    The area is one circle. It is a list of circles if these cover less sky than a single one.
    """
    link, groups = _LINK, _groups(ra, dec, _LINK)
    while len(groups) > _MAX_PATCHES:
        link *= 2.0
        groups = _groups(ra, dec, link)
    circles = [_enclosing_circle(ra[group], dec[group], radius[group]) for group in groups]
    enclosing = _enclosing_circle(ra, dec, radius)
    # Prefer the single circle unless several circles together cover less sky.
    if sum(size**2 for *_, size in circles) >= enclosing[2] ** 2:
        return "cone = {{ ra = {:g}, dec = {:g}, radius = {:g} }}".format(*enclosing)
    return f"patches = [{', '.join('[{:g}, {:g}, {:g}]'.format(*circle) for circle in circles)}]"


def _groups(ra: Float, dec: Float, link: float) -> list[Int]:
    """Divide positions (deg) into groups, and return each group as an array of indices of its positions.

    All positions of a group lie within `link` deg of its first position.
    """
    remaining, groups = np.arange(len(ra)), []
    while len(remaining):
        in_group = sky.separation(ra[remaining], dec[remaining], ra[remaining[0]], dec[remaining[0]]) <= link
        groups.append(remaining[in_group])
        remaining = remaining[~in_group]
    return groups


def _enclosing_circle(ra: Float, dec: Float, radius: Float) -> tuple[float, float, float]:
    """Return ra, dec and radius (deg) of one circle whose order-8 HEALPix cells contain all sources of the circles.

    The centre is rounded to 0.001 deg. The radius is rounded up to a multiple of 0.01 deg and at most 180 deg.
    """
    x, y, z = pointing.basis(ra, dec)[2].mean(axis=1)
    lon = round(float(np.degrees(np.arctan2(y, x))) % 360.0, 3) % 360.0
    lat = round(float(np.degrees(np.arctan2(z, np.hypot(x, y)))), 3)
    reach = float((sky.separation(ra, dec, lon, lat) + radius).max()) + FARTHEST_MOVED
    circle_radius = min(np.ceil(100.0 * reach) / 100.0, 180.0)
    # HEALPix cells of the given circles may extend beyond the enclosing circle. Enlarge the enclosing circle until its
    # own cells include them.
    while circle_radius < 180.0 and not _is_covered(Area(ra=lon, dec=lat, radius=circle_radius), ra, dec, radius).all():
        circle_radius = min(round(circle_radius + 0.01, 2), 180.0)
    return lon, lat, float(circle_radius)
