"""Rows of the lake that a detector is rendered from.

aimed       a detector of an exposure, and its variant of the request
prepared    the same with the catalogue rows that it may see, and earlier exposures of the detector
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import pyarrow.compute as pc

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.published import read_back
from lake_schema.store import read
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.store.plan import Json
from lake_schema.store.provenance import file_sha256
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes.inputs import library_of, passband_of, stars_of
from truesky.render.camera import detectors
from truesky.render.channels import registry
from truesky.render.channels.aim import Aim
from truesky.render.drawing import stamp_sizes
from truesky.render.exposure import elsewhere, persistence, visible_sources, visible_spectra
from truesky.render.exposure.records import Earlier, EarlierSky, Rows, Variant
from truesky.render.planning import parts, variants
from truesky.render.psf import from_file
from truesky.render.sources import catalogue_rows, ephemerides, galaxy_stamps, solar_system
from truesky.render.sources.catalogue_rows import LENSES
from truesky.render.sources.disc_structure import DiscStructure
from truesky.render.sources.solar_system import Population
from truesky.request.accuracy import Accuracy
from truesky.request.structure import Arms, Stamps


def aimed(lake: Folder, facts: Json) -> tuple[Aim, Variant, MissionConfiguration]:
    """A detector as it looks at the sky, its exposure's variant, and the request's mission; facts : of `prepared`."""
    request = facts["request"]
    forced = dict.fromkeys(request["effects"]["on"], True) | dict.fromkeys(request["effects"]["off"], False)
    inputs = {
        name: read.version(lake, name, facts["inputs"][name]) for name in ("exposures", "galaxy_fluxes", "mission")
    }
    number, here = [facts["exposure_id"]], pc.field("exposure_id") == facts["exposure_id"]
    (exposed,) = map(ExposureRow.of, parts.rows(inputs["exposures"], number, where=here).to_pylist())
    mission = read_back(inputs["mission"])
    own = variants.variant(exposed.settings, mission, Accuracy(**request["accuracy"]), forced)
    detector = detectors.detector(exposed.camera, facts["detector"], own.mission)
    band = passband_of(lake, inputs["galaxy_fluxes"].manifest["facts"], exposed.band)
    return Aim.of(exposed, detector, band, request["seed"], request["readout"]), own, mission


def prepared(lake: Folder, facts: Json) -> tuple[Aim, Rows, Variant]:
    """What a detector is rendered from.

    facts  : of the plan and of its part: exposure_id, detector
    Errors : BadInput where a file of the user's has changed since the plan was made
    """
    request, (aim, own, mission) = facts["request"], aimed(lake, facts)
    exposed, inputs = aim.exposure, {name: read.version(lake, name, key) for name, key in facts["inputs"].items()}
    number = facts["exposure_id"]
    here = (pc.field("exposure_id") == number) & (pc.field("detector") == facts["detector"])
    (task,) = parts.rows(inputs["tasks"], [number], where=here).to_pylist()
    earlier = earlier_exposures(lake, inputs, exposed, task, mission, request["seed"])
    for one in (exposed, *(before.exposure for before in earlier if isinstance(before, Earlier))):
        if one.psf:
            file = str(from_file.file_of(one.psf, task["detector"]))
            if file_sha256(Path(file)) != facts["psf"][file]:
                raise BadInput(f"{file}: has changed since the rendering began")
    bodies = solar_system.nobody if request.get("bodies") == "none" else None
    if registry.CHANNELS[exposed.channel].sees_bodies(exposed.image_type):
        for file, sha256 in facts.get("bodies", {}).items():
            if file_sha256(Path(file)) != sha256:
                raise BadInput(f"{file}: has changed since the rendering began")
            bodies = ephemerides.read(Path(file), sha256).of_day
    rows = _rows(lake, inputs, aim, task, own, bodies, earlier, request["seed"])
    return aim, _with_structure(rows, request, facts.get("stamps", {})), own


def _with_structure(rows: Rows, request: Json, files: Mapping[str, str]) -> Rows:
    """The rows, and what galaxies have beside their profiles; files : sha256 of a library, by file."""
    wanted, seed = request.get("structure", {}), request["seed"]
    if "arms" in wanted:
        rows = replace(rows, discs=DiscStructure(Arms(**wanted["arms"]), seed))
    for file, sha256 in files.items():
        rows = replace(rows, stamps=galaxy_stamps.of_file(Stamps(Path(file), **wanted["stamps"]), seed, sha256))
    return rows


def _rows(
    lake: Folder,
    inputs: Mapping[str, read.Version],
    aim: Aim,
    task: Json,
    own: Variant,
    bodies: Callable[[int], Population] | None,
    earlier: tuple[Earlier | EarlierSky, ...],
    seed: int,
) -> Rows:
    """The sources of a detector, from its own cells and, where they shine so far, from those about."""
    exposed, detector, band = aim.exposure, aim.detector, aim.band
    margin = aim.channel.margin(detector.section, own.mission)
    spread = visible_spectra.beyond(exposed, detector, own.mission, band, seed)
    farther = max(stamp_sizes.reach(detector.pixel_scale) - margin, spread - margin, 0.0)
    limits = visible_sources.flux_limits(exposed, detector, band, own)
    found = []
    for rows, fluxes, columns, limit in (
        ("galaxies", "galaxy_fluxes", visible_sources.GALAXY_COLUMNS, limits.far_galaxy),
        ("stars", "star_fluxes", visible_sources.STAR_COLUMNS, limits.spikes),
    ):
        bands = visible_spectra.bands(exposed, inputs[fluxes].schema.names)
        versions = inputs[rows], inputs[fluxes]
        found.append(catalogue_rows.sources(*versions, task, columns, bands, farther, limits.least, limit))
    lenses = None
    if LENSES in inputs:
        deflection = catalogue_rows.deflection_of(inputs["galaxies"])
        lenses = catalogue_rows.lenses(inputs[LENSES], task, deflection, farther, limits.least)
        versions = inputs["galaxies"], inputs["galaxy_fluxes"]
        behind = catalogue_rows.with_lensed(found[0][:2], lenses, *versions, task, farther)
        found[0] = *behind, found[0][2]
    return Rows(
        *found[0][:2],
        *found[1][:2],
        library=library_of(lake, inputs["galaxy_fluxes"].manifest["facts"]),
        stellar=stars_of(lake, inputs["star_fluxes"].manifest["facts"]),
        complete=margin + min(complete for *_, complete in found),
        lenses=lenses,
        bodies=bodies,
        earlier=earlier,
        beside=elsewhere.stars(inputs, aim, own),
    )


def earlier_exposures(
    lake: Folder,
    inputs: Mapping[str, read.Version],
    exposed: ExposureRow,
    task: Json,
    mission: MissionConfiguration,
    seed: int,
) -> tuple[Earlier | EarlierSky, ...]:
    """Find earlier exposures of a detector that left charge in it.

    Parameters
    ----------
    lake : Path or Place
        The lake.
    inputs : mapping of str to Version
        Versions of the tables that the images are made of.
    exposed : ExposureRow
        Exposure whose detector it is.
    task : dict
        Row of the table `tasks`.
    mission : MissionConfiguration
        Mission configuration of the request.
    seed : int
        Seed of the request.

    Returns
    -------
    tuple of Earlier or EarlierSky
        The exposures with their bright sources, or with the level of their sky alone if nothing renders them.
    """
    if registry.CHANNELS[exposed.channel].remembers is None:
        return ()
    own = variants.missions(mission)
    since = exposed.mjd - persistence.window(exposed.camera, own(exposed.settings))
    near = (pc.field("mjd") >= since) & (pc.field("mjd") <= exposed.mjd)
    same = pc.field("camera") == exposed.camera
    found = parts.rows(inputs["exposures"], dates=(since, exposed.mjd), where=near & same).to_pylist()
    rows = {row.exposure_id: row for row in map(ExposureRow.of, found)}
    here = pc.field("exposure_id").isin(list(rows)) & (pc.field("detector") == task["detector"])
    tasks = parts.rows(inputs["tasks"], rows, where=here).to_pylist()
    before = persistence.earlier_of(tasks, rows, own)[exposed.exposure_id, task["detector"]]
    pairs = [(rows[one["exposure_id"]], one) for one in before]
    drawn = [pair for pair in pairs if persistence.is_drawn(pair[0])]
    again = {one.exposure.exposure_id: one for one in _drawn_again(lake, inputs, exposed, drawn, own, seed)}
    return tuple(again.get(row.exposure_id, EarlierSky(row)) for row, _ in pairs)


def _drawn_again(
    lake: Folder,
    inputs: Mapping[str, read.Version],
    exposed: ExposureRow,
    drawn: Sequence[tuple[ExposureRow, Json]],
    mission_of: Callable[[str | None], MissionConfiguration],
    seed: int,
) -> list[Earlier]:
    """With the sources of each that leave something; drawn : earlier exposures and the tasks of the same detector."""
    if not drawn:
        return []
    fluxes = inputs["galaxy_fluxes"].manifest["facts"]
    aims, galaxies, stars = [], [], []
    for before, task in drawn:
        mission = mission_of(before.settings)
        detector = detectors.detector(before.camera, task["detector"], mission)
        aim = Aim.of(before, detector, passband_of(lake, fluxes, before.band), seed)
        least = persistence.least_flux(exposed, before, persistence.brightest_column(aim, mission))
        beyond = visible_spectra.beyond(before, detector, mission, aim.band, seed)
        farther = max(beyond - aim.channel.margin(detector.section, mission), 0.0)
        # In images their colours are taken as flat.
        spread = aim.channel.disperses is not None
        shapes = visible_sources.GALAXY_COLUMNS if spread else visible_sources.SHAPE_COLUMNS
        galaxies.append(catalogue_rows.Bright(task, shapes, before.band, least, farther))
        stars.append(replace(galaxies[-1], columns=visible_sources.STAR_COLUMNS))
        aims.append((aim, mission))
    library, stellar = library_of(lake, fluxes), stars_of(lake, inputs["star_fluxes"].manifest["facts"])
    of_galaxies = catalogue_rows.bright(inputs["galaxies"], inputs["galaxy_fluxes"], galaxies)
    of_stars = catalogue_rows.bright(inputs["stars"], inputs["star_fluxes"], stars)
    return [
        Earlier(aim, Rows(*some, *others, library=library, stellar=stellar), mission)
        for (aim, mission), some, others in zip(aims, of_galaxies, of_stars, strict=True)
    ]
