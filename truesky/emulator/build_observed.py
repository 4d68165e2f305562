"""Make the table `observed`: the catalogued sources of a lake as its plan would observe them.

spark-submit jobs/catalogue/build_observed.py --lake LAKE --request REQUEST --model MODEL [MODEL ..] [--extrapolate]
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema import sky, units, user_files
from lake_schema.arrays import Array, Float
from lake_schema.errors import BadInput
from lake_schema.store import layout, read
from lake_schema.store.plan import Json, Output, Plan, Task
from lake_schema.store.provenance import code_version
from lake_schema.tables.survey.observed import observed_sources
from truesky.command_line import simulation
from truesky.emulator import features, observation
from truesky.emulator import model as models_of_files
from truesky.emulator.model import Model
from truesky.emulator.observation import Conditions, Sources
from truesky.emulator.train import SIZE_COLUMNS, galaxy_radius
from truesky.randomness.per_source import PerSourceGenerator
from truesky.render.channels.image_types import SKY_TYPES
from truesky.request import universe
from truesky.request.schema import Request
from truesky.running.submitted_job import Job, Step
from truesky.survey_maps.depth_lookup import DepthMap, read_depth_map

# Fluxes (uJy) below this count as this: such sources are never detected.
_NO_FLUX = 1e-12
_DEPTH_COLUMNS = ("depth_point", "psf_area", "covered")
# HEALPix order of the cells around a partition whose sources are read: 26 arcsec, wider than a margin (10 arcsec).
_MARGIN_ORDER = 13
_CATALOGUES = ("galaxies", "galaxy_fluxes", "stars", "star_fluxes")


def steps(lake: Path, request: Request) -> list[Step]:
    """Plan the making of the table `observed`, with one task per partition (file) of the galaxies.

    Parameters
    ----------
    lake : Path
        Folder of the lake, with catalogues, fluxes, the plan of exposures and the table `depth`.
    request : Request
        The request, with the files of models.

    Returns
    -------
    list of Step
        One step.

    Raises
    ------
    BadInput
        If a model is damaged, or does not belong to the plan; if a table is missing, or was made from an older version
        of another; if the catalogue of galaxies is shallower than the images in the band of its limit; or if depths are
        outside the ranges of the models without --extrapolate.
    """
    models = _models(request)
    catalogues = {name: read.input_version(lake, name, request.name) for name in _CATALOGUES}
    universe.check_catalogues([catalogues["galaxies"], catalogues["stars"]], request)
    for name, fluxes in (("galaxies", "galaxy_fluxes"), ("stars", "star_fluxes")):
        _check_fluxes(catalogues[fluxes], catalogues[name], [model.band for model in models])
    exposures = read.input_version(lake, "exposures", request.name)
    _check_plan(exposures, models)
    depth = _depth_version(lake, request.name, exposures)
    for model in models:
        _check_depth(depth, model, request)
    facts = {
        "seed": request.seed, "depth": depth.key, "code": code_version(),
        "models": [model.sha256 for model in models],
        **{name: version.key for name, version in catalogues.items()},
    }  # fmt: skip
    tasks = tuple(Task(name, {"part": name}) for name in catalogues["galaxies"].partitions)
    table = observed_sources([model.band for model in models])
    # Workers may have another current folder.
    files = tuple(str(Path(name).absolute()) for name in request.model)
    return [Step(Plan(table, facts, tasks), partial(observe_partition, files))]


def observe_partition(files: Sequence[str], lake: Path, facts: Json) -> Output:
    """Observe the sources of one partition.

    Parameters
    ----------
    files : sequence of str
        Files of the models.
    lake : Path
        Folder of the lake.
    facts : dict
        Parameters of the job and of the task; `part` is the name of the partition.

    Returns
    -------
    Output
        Rows of the table `observed` whose positions are in the cell of the partition and in the plan's fields of view.

    Raises
    ------
    BadInput
        If a file of a model is not the one of the job's start.

    Notes
    -----
    Sources in the margin are observed as well, because their measured positions may be inside the cell. Each has the
    same measurements in the partitions of both cells.
    """
    models = [models_of_files.read_model(Path(name)) for name in files]
    if changed := [name for name, model in zip(files, models, strict=True) if model.sha256 not in facts["models"]]:
        raise BadInput(f"--model {user_files.format_path(changed[0])}: it was replaced during the job; run it again")
    bands = [model.band for model in models]
    order, cell = layout.cell_of_file(facts["part"])
    sources = _sources(lake, facts, bands, order, cell)
    depth = read.version(lake, "depth", facts["depth"])
    partitions = _overlapping_partitions(depth.partitions, order, cell, 1)
    chance = PerSourceGenerator(sources.ids, facts["seed"], "emulator.coverage").random()
    conditions = {model.band: _conditions(depth, model, partitions, sources, chance) for model in models}
    is_covered = np.any([condition.is_covered for condition in conditions.values()], axis=0)
    columns = observation.observe(sources, conditions, models, facts["seed"])
    index = sky.healpix_29(columns["ra"], columns["dec"])
    first, last = sky.cell_range(order, cell)
    chosen = np.flatnonzero((index >= first) & (index < last) & is_covered)
    chosen = chosen[np.lexsort((sources.ids[chosen], index[chosen]))]
    table = observed_sources(bands)
    return Output(table.build({name: values[chosen] for name, values in (*columns.items(), ("_healpix_29", index))}))


def _models(request: Request) -> list[Model]:
    """Return the models of a request; raise BadInput without models, or if two do not fit together."""
    if not request.model:
        raise BadInput("--model is required: make a model with truesky train LAKE --out MODEL")
    models = [models_of_files.read_model(Path(name)) for name in request.model]
    first = models[0]
    for i, model in enumerate(models):
        name = user_files.format_path(request.model[i])
        if any(model.band == other.band for other in models[:i]):
            raise BadInput(f"--model {name}: a model of band {model.band} is given twice")
        if model.facts["settings"] != first.facts["settings"]:
            differing = [key for key, value in first.facts["settings"].items() if model.facts["settings"][key] != value]
            values = ", ".join(f"{key} {model.facts['settings'][key]:g}" for key in differing)
            raise BadInput(
                f"--model {name}: it was trained with other settings of the detection than the first model: {values}"
            )
    return models


def _check_fluxes(fluxes: read.Version, catalogue: read.Version, bands: Sequence[str]) -> None:
    """Raise BadInput if a table of fluxes belongs to another catalogue, or lacks the column of a band."""
    if fluxes.manifest["facts"].get("input") != catalogue.key:
        raise BadInput(
            f"table {fluxes.table} was computed from another version of {catalogue.table}: run truesky fluxes"
        )
    missing = [band for band in bands if f"f_nu_{band}" not in fluxes.schema.names]
    if missing:
        raise BadInput(
            f"table {fluxes.table} has no fluxes in {', '.join(missing)}: run truesky fluxes with these bands"
        )


def _check_plan(exposures: read.Version, models: Sequence[Model]) -> None:
    """Raise BadInput if the plan does not observe the band of each model with its camera, and with no other."""
    rows = exposures.rows(["camera", "band", "image_type"])
    rows = rows.filter(pc.is_in(rows["image_type"], pa.array(SKY_TYPES)))
    planned = set(zip(rows["camera"].to_pylist(), rows["band"].to_pylist(), strict=True))
    for model in models:
        cameras = sorted(camera for camera, band in planned if band == model.band)
        if len(cameras) > 1:
            raise BadInput(
                f"--model: the plan observes {model.band} with the cameras {' and '.join(cameras)}, and the depth does "
                "not tell them apart: emulate them with requests that have one camera each"
            )
        if (model.camera, model.band) in planned:
            continue
        if cameras:
            raise BadInput(
                f"--model: the model of {model.band} is one of camera {model.camera}, but the plan has {cameras[0]}"
            )
        bands = ", ".join(sorted({band for _, band in planned})) or "none"
        raise BadInput(f"--model: there is a model of band {model.band}, but the bands of the plan are {bands}")


def _depth_version(lake: Path, name: str, exposures: read.Version) -> read.Version:
    """Return the depth of the plan of a request; raise BadInput if it is missing, or belongs to another plan."""
    if layout.current_key(lake, "depth") is None:
        raise BadInput(f"lake {lake} has no table depth: run truesky depth REQUEST {lake} first")
    depth = read.input_version(lake, "depth", name)
    if depth.manifest["facts"].get("exposures") != exposures.key:
        raise BadInput("table depth was made from another plan: run truesky depth first")
    return depth


def _check_depth(depth: read.Version, model: Model, request: Request) -> None:
    """Raise BadInput if a model is not valid at the depths of its band, or the galaxies are shallower than the images.

    Depths are read one partition after the other, to save memory.
    """
    count, outside, lowest, highest = 0, 0, np.inf, -np.inf
    for partition in depth.partitions:
        rows = depth.rows(["band", "depth_point"], [partition])
        values = rows.filter(pc.equal(rows["band"], pa.scalar(model.band)))["depth_point"].to_numpy()
        count, outside = count + len(values), outside + int(model.is_extrapolated(values).sum())
        lowest, highest = min(lowest, values.min(initial=np.inf)), max(highest, values.max(initial=-np.inf))
    if not count:
        raise BadInput(f"table depth has no band {model.band}: run truesky depth again")
    if outside and not request.extrapolate:
        low, high = model.depths
        raise BadInput(
            f"depth in {model.band} is {lowest:.2f} to {highest:.2f} mag, but the model is valid from {low:.2f} to "
            f"{high:.2f}: {100.0 * outside / count:.3g} % are outside; train on such images, or add --extrapolate"
        )
    half, limit = highest + model.half_detected(), request.universe.galaxy_limit
    if model.band == request.universe.galaxy_band and limit < half:
        raise BadInput(
            f"universe.galaxy_limit {limit:g} is {half - limit:.2f} mag brighter than {half:.2f}, at which half of the "
            f"galaxies are detected in {model.band}: set it to {np.ceil(10.0 * half) / 10.0:.1f} or fainter"
        )


def _sources(lake: Path, facts: Json, bands: Sequence[str], order: int, cell: int) -> Sources:
    """Return the galaxies and stars in a cell and its margin."""
    galaxies = _rows(lake, facts, ("galaxies", "galaxy_fluxes"), SIZE_COLUMNS, bands, (order, cell))
    stars = _rows(lake, facts, ("stars", "star_fluxes"), (), bands, (order, cell))
    radius = galaxy_radius({name: galaxies[name] for name in SIZE_COLUMNS})
    radius = np.where(features.is_point(galaxies["id"]), 0.0, radius)
    both = {name: np.concatenate([galaxies[name], stars[name]]) for name in stars}
    magnitude = {band: units.mag_of_f_nu(np.maximum(both[band].astype(float), _NO_FLUX)) for band in bands}
    return Sources(
        both["id"], both["ra"], both["dec"], np.concatenate([radius, np.zeros(len(stars["id"]))]), magnitude
    )  # fmt: skip


def _rows(
    lake: Path,
    facts: Json,
    tables: tuple[str, str],
    columns: Sequence[str],
    bands: Sequence[str],
    place: tuple[int, int],
) -> dict[str, Array]:
    """Return columns of a catalogue and its fluxes in a cell and its margin, each source once."""
    catalogue, fluxes = (read.version(lake, name, facts[name]) for name in tables)
    names, flux_names = ["id", "ra", "dec", *columns], ["id", *(f"f_nu_{band}" for band in bands)]
    partitions = _overlapping_partitions(catalogue.partitions, *place, 0)
    read_rows = _with_margins(catalogue, partitions, [*names, "_healpix_29"])
    read_fluxes = _with_margins(fluxes, partitions, flux_names)
    if not read_rows["id"].equals(read_fluxes["id"]):
        raise BadInput(
            f"table {fluxes.table} was computed from another version of {catalogue.table}: run truesky fluxes"
        )
    # Cells of stars are up to 16 times larger than cells of galaxies: all their stars would be observed 16 times.
    fine = sky.parent(read_rows["_healpix_29"].to_numpy(), sky.MAX_ORDER, _MARGIN_ORDER)
    is_near = sky.parent(fine, _MARGIN_ORDER, place[0]) == place[1]
    is_near |= np.isin(fine, sky.margin_cells(*place, _MARGIN_ORDER))
    rows_here = np.flatnonzero(is_near)
    first = rows_here[np.unique(read_rows["id"].to_numpy()[rows_here], return_index=True)[1]]
    out: dict[str, Array] = {name: read_rows[name].to_numpy()[first] for name in names}
    return out | {band: read_fluxes[f"f_nu_{band}"].to_numpy()[first] for band in bands}


def _with_margins(version: read.Version, partitions: Sequence[str], columns: list[str]) -> pa.Table:
    margins = [version.read_margin(partition, columns) for partition in partitions]
    return pa.concat_tables([version.rows(columns, partitions), *margins])


def _overlapping_partitions(partitions: Sequence[str], order: int, cell: int, margin: int) -> list[str]:
    """Return the partitions whose cells overlap a cell, or with `margin` 1 also those that touch its margin."""
    first, last = sky.cell_range(order, cell)
    fine = sky.margin_cells(order, cell, order + 6) if margin else np.zeros(0, np.int64)
    chosen = []
    for partition in partitions:
        own_first, own_last = sky.cell_range(*layout.cell_of_file(partition))
        starts = fine << 2 * (29 - order - 6)
        touches = bool(((starts >= own_first) & (starts < own_last)).any())
        if (own_first < last and first < own_last) or touches:
            chosen.append(partition)
    return chosen


def _conditions(
    depth: read.Version, model: Model, partitions: Sequence[str], sources: Sources, chance: Float
) -> Conditions:
    """Return the conditions in the band of a model at sources; those without exposure get means of the training.

    A source is covered if its number `chance`, from 0 to 1, is below the covered fraction of its depth pixel, as random
    points are. Otherwise the area of two adjacent VIS detectors would be 5 % too large.
    """
    middle = {name: float(np.mean(model.facts["conditions"][name])) for name in ("depth", "psf_area")}
    count = len(sources.ids)
    try:
        depth_map: DepthMap | None = (
            read_depth_map(depth, model.band, _DEPTH_COLUMNS, partitions) if partitions else None
        )
    except BadInput:
        # The band has no exposure in this cell.
        depth_map = None
    if depth_map is None:
        return Conditions(np.zeros(count, bool), np.full(count, middle["depth"]), np.full(count, middle["psf_area"]))
    rows = depth_map.rows_at(sources.ra, sources.dec)
    is_covered = (rows >= 0) & (chance < depth_map.columns["covered"][rows])

    def values(name: str, default: float) -> Float:
        return np.where(is_covered, depth_map.columns[name][rows].astype(float), default)

    return Conditions(
        is_covered, values("depth_point", middle["depth"]), values("psf_area", middle["psf_area"])
    )  # fmt: skip


JOB = Job(
    "build_observed",
    "Draw what the planned images would show of galaxies and stars.",
    steps,
    list_options=simulation.EMULATE_LISTS,
    flag_options=simulation.EMULATE_FLAGS,
)
