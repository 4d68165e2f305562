"""Render the planned exposures: spark-submit jobs/render/render_exposures.py --lake LAKE --request REQUEST."""

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.published import read_back
from lake_schema.store import layout, names, parquet, read, reuse
from lake_schema.store.plan import Json, Output, Part, Plan
from lake_schema.store.provenance import file_sha256
from lake_schema.tables.exposures import ExposureRow
from lake_schema.tables.products import PRODUCTS
from lake_schema.tables.rendered_truth import RENDERED_SPECTRA, RENDERED_TRUTH
from truesky.fluxes.inputs import library_of, passband_of, stars_of
from truesky.render.camera import detectors
from truesky.render.channels import registry
from truesky.render.channels.aim import Aim
from truesky.render.drawing import stamp_sizes
from truesky.render.exposure import elsewhere, persistence, render, visible_sources, visible_spectra
from truesky.render.exposure.records import Earlier, EarlierSky, Rows, Variant
from truesky.render.planning import parts, preconditions, variants
from truesky.render.planning.mission import mission_of
from truesky.render.planning.preconditions import INPUTS
from truesky.render.products import exposure_files, fits_files, truth_table
from truesky.render.products.beside import psf_file, spectra_file, truth_file
from truesky.render.products.keys import ephemeris_files, exposures_of, part_name, product_keys, psf_files, stamp_files
from truesky.render.psf import from_file, to_psfex
from truesky.render.sources import catalogue_rows, ephemerides, galaxy_stamps, selection, solar_system
from truesky.render.sources.catalogue_rows import LENSES
from truesky.render.sources.disc_structure import DiscStructure
from truesky.render.sources.solar_system import Population
from truesky.request import structure
from truesky.request.accuracy import Accuracy
from truesky.request.schema import WRITTEN, Request
from truesky.request.structure import Arms, Stamps
from truesky.running import heap
from truesky.running.shell import Job, Step, common_facts


def steps(lake: Path, request: Request) -> list[Step]:
    """One part a detector of an exposure, the longest first; then what was drawn on each, and files of whole exposures.

    Detectors that are not asked for, and that the request's present version has as they would be rendered now, stay:
    a part is added to what there is.
    """
    inputs = inputs_of(lake, request)
    preconditions.refuse_other_plan(inputs, request)
    held = exposures_of(reuse.held(lake, PRODUCTS.name, request.name))
    chosen = parts.chosen(inputs["exposures"], inputs["tasks"], request, held)
    own = variants.missions(mission_of(request.mission))
    exposures, earlier = parts.before(inputs, chosen.exposures, chosen.asked, own)
    needed = _with_earlier(chosen.asked, earlier, exposures)
    places = {tuple(task[k] for k in ("ra", "dec", "radius")): task for task in needed if task["cells"]}
    for name in ("galaxies", "stars"):
        of_task = [selection.needed(task, catalogue_rows.deflection_of(inputs[name])) for task in places.values()]
        preconditions.refuse_uncovered(inputs[name], {cell for cells in of_task for cell in cells})
    plan = products(lake, request, inputs, chosen.exposures, chosen.tasks, chosen.asked)
    drawn = tuple(Part(part.name, {"part": part.name, reuse.PRODUCT: part.facts[reuse.PRODUCT]}) for part in plan.parts)
    steps = [Step(plan, work, unit="detector"), Step(Plan(RENDERED_TRUTH, {"products": plan.key}, drawn), truth_work)]
    spread = _dispersed(chosen.exposures)
    spectra = tuple(own for own, part in zip(drawn, plan.parts, strict=True) if part.facts["exposure_id"] in spread)
    if spectra:
        steps.append(Step(Plan(RENDERED_SPECTRA, {"products": plan.key}, spectra), spectra_work))
    if request.files == "exposure":
        steps.append(Step(exposure_files.plan(plan, chosen.planned), exposure_files.work, unit="exposure"))
    return steps


def _dispersed(exposures: pa.Table) -> set[int]:
    """Exposures whose sources are spread out by a grism."""
    found = set()
    for row in map(ExposureRow.of, exposures.to_pylist()):
        channel = registry.CHANNELS.get(row.channel)
        if channel is not None and channel.disperses is not None and channel.sees_sky(row.image_type):
            found.add(row.exposure_id)
    return found


def inputs_of(lake: Path, request: Request) -> dict[str, read.Version]:
    """The versions of the tables that a request's images are made of, by name."""
    inputs = {name: read.for_request(lake, name, request.name) for name in INPUTS}
    lenses = _lenses(lake, request, inputs["galaxies"])
    return inputs if lenses is None else {**inputs, LENSES: lenses}


def products(
    lake: Path,
    request: Request,
    inputs: Mapping[str, read.Version],
    exposures: pa.Table,
    every: Sequence[Json],
    asked: Sequence[Json],
) -> Plan:
    """The plan of the table `products`: what is asked for, and what the request has and keeps.

    lake, request : folder, and what is asked;  inputs : versions of the tables that are read
    exposures     : rows of the table that hold the tasks
    every, asked  : rows of the table `tasks`: those to be rendered now, and at least all that the request has already
    """
    facts = {
        **common_facts(request, "seed", "noise_seed", "accuracy", "mission", "effects", "truth", *WRITTEN),
        "mission": mission_of(request.mission).fingerprint,
        "inputs": {name: version.key for name, version in inputs.items()},
    }
    if request.sources is not None:
        # Those of the tables are the only ones: no bodies move.
        facts["request"]["bodies"] = "none"
    facts["request"].update(structure.facts(request.structure))
    if request.bodies is not None:
        facts["bodies"] = ephemeris_files(request.bodies, exposures)
    if request.structure.stamps is not None:
        facts["stamps"] = stamp_files(request.structure.stamps.file)
    held = reuse.held(lake, PRODUCTS.name, request.name)
    wanted = {part_name(task) for task in asked}
    exposures, earlier = parts.before(inputs, exposures, every, variants.missions(mission_of(request.mission)))
    tasks = _with_held(wanted, every, exposures, held, earlier)
    psfs = psf_files(exposures, _with_earlier(tasks, earlier, exposures))
    keys = product_keys({**facts, "psf": psfs}, exposures, tasks, inputs, mission_of(request.mission), earlier)
    made = tuple(
        Part(name, {"exposure_id": task["exposure_id"], "detector": task["detector"], reuse.PRODUCT: key})
        for task, key in zip(tasks, keys, strict=True)
        if (name := part_name(task)) in wanted or held[name] == key
    )
    if len(made) < len(tasks):
        stay = {part.name for part in made}
        kept = [task for task in tasks if part_name(task) in stay]
        psfs = psf_files(exposures, _with_earlier(kept, earlier, exposures))
    return Plan(PRODUCTS, {**facts, "psf": psfs} if psfs else facts, made)


def _with_earlier(
    tasks: Sequence[Json], earlier: Mapping[tuple[int, str], Sequence[Json]], exposures: pa.Table
) -> list[Json]:
    """The tasks, and those before them whose sources are drawn again."""
    if not earlier:
        return list(tasks)
    rows = map(ExposureRow.of, exposures.to_pylist())
    drawn = {row.exposure_id for row in rows if persistence.is_drawn(row)}
    before = (one for task in tasks for one in earlier.get((task["exposure_id"], task["detector"]), ()))
    return [*tasks, *(one for one in before if one["exposure_id"] in drawn)]


def _with_held(
    wanted: Set[str],
    every: Sequence[Json],
    exposures: pa.Table,
    held: Mapping[str, str],
    earlier: Mapping[tuple[int, str], Sequence[Json]],
) -> list[Json]:
    """Tasks of the parts that are wanted, and of those that are held whose PSFs can still be read, in their order."""
    psfs = dict(zip(exposures["exposure_id"].to_pylist(), exposures["psf"].to_pylist(), strict=True))

    def stays(task: Json) -> bool:
        drawn = [task, *earlier.get((task["exposure_id"], task["detector"]), ())]
        read = [from_file.file_of(psf, one["detector"]) for one in drawn if (psf := psfs[one["exposure_id"]])]
        return part_name(task) in held and all(file.is_file() for file in read)

    return [task for task in every if part_name(task) in wanted or stays(task)]


def _lenses(lake: Path, request: Request, galaxies: read.Version) -> read.Version | None:
    """The strong lenses, if there are some; those of another request only where they lie in the same galaxies."""
    if layout.current_key(lake, LENSES) is None:
        return None
    found, own = read.for_request(lake, LENSES, request.name), names.key_of(lake, request.name, LENSES)
    shared = own is None and found.key in names.holders(lake, LENSES).values()
    return None if shared and found.manifest["facts"].get("galaxies") != galaxies.key else found


def work(lake: Path, facts: Json) -> Output:
    """One detector: its sources from its own cells, its image, its files."""
    request = facts["request"]
    with heap.kept():
        aim, rows_, own = prepared(lake, facts)
        noise = request.get("noise_seed")
        rendered = render.render(aim, rows_, own, request["seed"], request["truth"], noise_seed=noise)
    rice, form = request["compression"] == "rice", request.get("wcs", "sip")
    rows, files = fits_files.products(rendered, request["truth"], rice, form)
    drawn = truth_table.truth(rendered)
    place = facts["exposure_id"], facts["detector"]
    files = {**files, truth_file(*place): lambda path: parquet.write(path, drawn, RENDERED_TRUTH)}
    spectra = truth_table.spectra(rendered)
    if spectra is not None:
        files[spectra_file(*place)] = lambda path: parquet.write(path, spectra, RENDERED_SPECTRA)
    if aim.channel.on_ground and rendered.psf is not None:
        model, exposure = rendered.psf, aim.exposure
        beside = psf_file(exposure.exposure_id, exposure.channel, exposure.band, aim.detector.name)
        files[beside] = lambda path: to_psfex.written(model, aim.detector, path)
    return Output(rows, files)


def aimed(lake: Path, facts: Json) -> tuple[Aim, Variant, MissionConfiguration]:
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
    return Aim.of(exposed, detector, band, request["seed"], request.get("readout", "raw")), own, mission


def prepared(lake: Path, facts: Json) -> tuple[Aim, Rows, Variant]:
    """What a detector is rendered from.

    facts  : of the plan and of its part: exposure_id, detector
    Errors : BadInput where a file of the user's has changed since the plan was made
    """
    request, (aim, own, mission) = facts["request"], aimed(lake, facts)
    exposed, inputs = aim.exposure, {name: read.version(lake, name, key) for name, key in facts["inputs"].items()}
    number = facts["exposure_id"]
    here = (pc.field("exposure_id") == number) & (pc.field("detector") == facts["detector"])
    (task,) = parts.rows(inputs["tasks"], [number], where=here).to_pylist()
    earlier = _earlier(lake, inputs, exposed, task, mission, request["seed"])
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
    lake: Path,
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
    least = visible_sources.least_flux(exposed, detector, own.mission, own.accuracy)
    spikes = visible_sources.spike_flux(exposed, detector, own.mission, own.accuracy, band)
    outer = visible_sources.outer_flux(exposed, detector, own.mission, own.accuracy)
    found = []
    for rows, fluxes, columns, limit in (
        ("galaxies", "galaxy_fluxes", visible_sources.GALAXY_COLUMNS, outer),
        ("stars", "star_fluxes", visible_sources.STAR_COLUMNS, spikes),
    ):
        bands = visible_spectra.bands(exposed, inputs[fluxes].schema.names)
        versions = inputs[rows], inputs[fluxes]
        found.append(catalogue_rows.sources(*versions, task, columns, bands, farther, least, limit))
    lenses = None
    if LENSES in inputs:
        deflection = catalogue_rows.deflection_of(inputs["galaxies"])
        lenses = catalogue_rows.lenses(inputs[LENSES], task, deflection, farther, least)
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


def _earlier(
    lake: Path,
    inputs: Mapping[str, read.Version],
    exposed: ExposureRow,
    task: Json,
    mission: MissionConfiguration,
    seed: int,
) -> tuple[Earlier | EarlierSky, ...]:
    """Exposures of the task's detector that left something in it, with their bright sources."""
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
    lake: Path,
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


def truth_work(lake: Path, facts: Json) -> Output:
    """What was drawn on one detector, from beside its images."""
    return _beside(lake, facts, truth_file)


def spectra_work(lake: Path, facts: Json) -> Output:
    """Where spectra lie on one detector, likewise."""
    return _beside(lake, facts, spectra_file)


def _beside(lake: Path, facts: Json, file_of: Callable[[int, str], str]) -> Output:
    products = read.version(lake, "products", facts["products"])
    (row, *_) = products.rows(["exposure_id", "detector"], [facts["part"]]).to_pylist()
    return Output(products.beside(file_of(row["exposure_id"], row["detector"])))


JOB = Job(
    "render_exposures",
    "Render every planned detector to FITS.",
    steps,
    options=(("detectors", "only these of every exposure"),),
    numbers=(("limit", "only the first so many of them, by exposure and detector"),),
)
