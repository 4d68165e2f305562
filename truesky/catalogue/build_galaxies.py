"""Build the tables `halos`, `halo_limits`, `galaxies` and `quarantine` of a request.

`halo_limits` contains the masses above which `halos` is complete. `quarantine` contains galaxies that are too close to
a lensing caustic for weak lensing.

Command: spark-submit jobs/catalogue/build_galaxies.py --lake LAKE --request REQUEST.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa

from lake_schema.errors import BadInput
from lake_schema.ids import FILE_ORDER, GENERATION_ORDER
from lake_schema.store import layout, parquet, read
from lake_schema.store.plan import Json, Output, Plan, Task
from lake_schema.store.provenance import code_version
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.halos import HALO_LIMITS, HALOS
from lake_schema.tables.quarantine import QUARANTINE
from truesky.catalogue import cells, dust_map, given_sources
from truesky.catalogue.external import ingest, mapping
from truesky.catalogue.galaxies import from_catalogue, galaxies, lensing, nearest_sed, observed_cells
from truesky.catalogue.galaxies.galaxies import GalaxyModel
from truesky.catalogue.galaxies.lensing import Shear
from truesky.catalogue.galaxies.nearest_sed import Training
from truesky.catalogue.halos import halo_catalogue, population
from truesky.catalogue.halos.halo_catalogue import LightCone
from truesky.catalogue.matter import boltzmann
from truesky.catalogue.request_checks import check_band, check_cosmology
from truesky.cosmology import Cosmology, from_facts
from truesky.fluxes import sources
from truesky.request.area import Area
from truesky.request.checks import check_rendered
from truesky.request.files import Catalogue, DustMap, Ingest, UserSources
from truesky.request.schema import Request, Universe
from truesky.running.submitted_job import Job, Step

_HALO_FACTS = ("galaxy_limit", "z_max", "box_cells", "structure_below_cells", "cosmology")
_LENS_FACTS = ("lensing", "rotation")
_GALAXY_FACTS = (*_HALO_FACTS, "lensing_nside", "alignment", *_LENS_FACTS, "high_redshift_boost", "quasar_boost")


def steps(lake: Path, request: Request) -> list[Step]:
    """Plan the making of the tables, with one task per HEALPix cell of order 5.

    A task draws all order-8 cells inside this cell that the area of the request touches.

    Parameters
    ----------
    lake : Path
        Folder of the lake.
    request : Request
        The request.

    Returns
    -------
    list of Step
        Steps that make `halos` and `halo_limits` (only if galaxies are drawn in halos), then `galaxies`, then
        `quarantine`.

    Raises
    ------
    BadInput
        If a file of the user is missing or wrong, or a passband is unknown.

    Notes
    -----
    If the galaxies are from a catalogue of the user, their halos are not known, and there are no tables of halos.
    Galaxies too close to a caustic are first stored in additional files next to the partitions of `galaxies`. The last
    step collects them in the table `quarantine`.
    """
    check_rendered(request)
    # Read the user's files now, so that an error in them is reported before any table is made.
    dust_map.map_for_request(request.seed, request.ingest.dust)
    if request.sources is not None:
        table_steps = [_given_step(request, request.sources)]
    elif request.ingest.galaxies is not None:
        table_steps = [_ingest_step(lake, request, request.ingest.galaxies)]
    else:
        table_steps = _draw_steps(lake, request)
    facts = {"galaxies": table_steps[-1].plan.key, "code": code_version()}
    quarantine = Plan(QUARANTINE, facts, (Task("all.parquet", {}),))
    return [*table_steps, Step(quarantine, collect_quarantine, on_driver=True)]


def _draw_steps(lake: Path, request: Request) -> list[Step]:
    universe = request.facts("universe")["universe"]
    # Galaxies do not depend on these.
    del universe["star_limit"]
    user_inputs = request.ingest
    check_band(request)
    cosmology = request.universe.cosmology
    check_cosmology(cosmology)
    # The user's training galaxies also change the table `halos`: their dust determines how faint galaxies must be
    # drawn, and therefore how light halos must be.
    external_facts = {
        name: _input_facts(catalogue, make_columns(dict(catalogue.columns), cosmology))
        for name, catalogue, make_columns in (
            ("halos", user_inputs.halos, mapping.halo_columns),
            ("training", user_inputs.training, mapping.training_columns),
        )
        if catalogue
    }
    facts = {
        "seed": request.seed,
        **universe,
        **external_facts,
        **dust_map.facts(user_inputs.dust),
        "code": code_version(),
    }
    version = boltzmann.camb_version(cosmology)
    camb_facts = {"camb": version} if version else {}
    facts |= camb_facts
    tasks = cells.tasks_of_area(request.area)
    halo_keys = ("seed", *_HALO_FACTS, "galaxy_band", *external_facts, *camb_facts, "code")
    halo_facts = {key: facts[key] for key in halo_keys}
    halos, limits = Plan(HALOS, halo_facts, tasks), Plan(HALO_LIMITS, halo_facts, (Task("all.parquet", {}),))
    # Store, with the table `galaxies`, the multipole up to which the power of the lensing agrees with linear theory
    # within 10 %.
    multipole_limit = {"lensing_l_max": facts["lensing_nside"]} if request.universe.lensing is None else {}
    plan = Plan(GALAXIES, {**facts, **multipole_limit}, tasks)
    if not layout.version_folder(lake, GALAXIES.name, plan.key).exists():
        # Make the simulated matter and its lensing maps once on the Spark driver; workers read them from the cache.
        _universe(facts, user_inputs)
    return [
        Step(halos, partial(draw_halos, user_inputs=user_inputs)),
        Step(limits, partial(list_halo_limits, user_inputs=user_inputs), on_driver=True),
        Step(plan, partial(draw_galaxies, user_inputs=user_inputs)),
    ]


def draw_halos(lake: Path, facts: Json, user_inputs: Ingest | None = None) -> Output:
    """Draw the halos of one task, that is in the requested order-8 cells inside one order-5 cell.

    Parameters
    ----------
    lake : Path
        Not used.
    facts : dict
        Parameters of the job and of the task; `generation_cells` are the order-8 cells to draw.
    user_inputs : Ingest, optional
        Section `ingest` of the request, with the user's files of halos and training galaxies.

    Returns
    -------
    Output
        Rows of table `halos`.
    """
    light_cone, training = _load_external(facts, user_inputs)
    universe = galaxies.halos_and_galaxies(facts["seed"], _universe_section(facts, _HALO_FACTS), light_cone, training)
    drawn_cells = population.CellCache(universe)
    return Output(cells.draw_rows(facts, HALOS, lambda cell: galaxies.halo_table(cell, universe, drawn_cells)))


def list_halo_limits(lake: Path, facts: Json, user_inputs: Ingest | None = None) -> Output:
    """Return the halo masses above which the table `halos` is complete, by redshift.

    Parameters
    ----------
    lake : Path
        Not used.
    facts : dict
        Parameters of the job.
    user_inputs : Ingest, optional
        Section `ingest` of the request, with the user's files of halos and training galaxies.

    Returns
    -------
    Output
        Rows of table `halo_limits`.
    """
    light_cone, training = _load_external(facts, user_inputs)
    universe = galaxies.halos_and_galaxies(facts["seed"], _universe_section(facts, _HALO_FACTS), light_cone, training)
    return Output(galaxies.halo_limits(universe))


def draw_galaxies(lake: Path, facts: Json, user_inputs: Ingest | None = None) -> Output:
    """Draw the galaxies whose observed (lensed) positions are in the requested order-8 cells inside one order-5 cell.

    Parameters
    ----------
    lake : Path
        Not used.
    facts : dict
        Parameters of the job and of the task; `generation_cells` are the order-8 cells to draw.
    user_inputs : Ingest, optional
        Section `ingest` of the request, with the user's files of halos, training galaxies and dust.

    Returns
    -------
    Output
        Rows of table `galaxies`. Galaxies too close to a caustic are in an additional file for the table `quarantine`.
    """
    universe = _universe(facts, user_inputs)
    dust = dust_map.map_for_request(facts["seed"], user_inputs.dust if user_inputs else None)
    drawn_cells = population.CellCache(universe.population)
    return _split_quarantine(facts, observed_cells.draw(facts["generation_cells"], universe, drawn_cells, dust))


def collect_quarantine(lake: Path, facts: Json) -> Output:
    """Collect the galaxies too close to a caustic from the additional files of all partitions of table `galaxies`.

    Parameters
    ----------
    lake : Path
        Folder of the lake.
    facts : dict
        Parameters of the job; `galaxies` is the key (hash) that identifies the version of table `galaxies`.

    Returns
    -------
    Output
        Rows of table `quarantine`; no rows if there are no such galaxies.
    """
    version = read.version(lake, GALAXIES.name, facts["galaxies"])
    existing = {entry["path"] for entry in version.manifest["files"]}
    names = (quarantine_file(part["facts"]["generation_cells"]) for part in version.manifest["parts"])
    tables = [version.read_sidecar(name) for name in names if name in existing]
    return Output(pa.concat_tables([QUARANTINE.empty(), *tables]))


def quarantine_file(generation_cells: Sequence[int]) -> str:
    """Return the path of the additional file with the galaxies of order-8 cells, as far as they are near a caustic.

    All cells must be in the same order-5 cell. The path is relative to the folder of table `galaxies`. The file exists
    only if galaxies are too close to a caustic for weak lensing.
    """
    return f"quarantine/{layout.cell_file(FILE_ORDER, generation_cells[0] >> 2 * (GENERATION_ORDER - FILE_ORDER))}"


def _split_quarantine(facts: Json, rows: pa.Table) -> Output:
    kappa, gamma1, gamma2 = (rows[name].to_numpy().astype(float) for name in ("kappa", "gamma1", "gamma2"))
    quarantined = lensing.is_near_caustic(kappa, gamma1, gamma2, lensing.settings().caustic)
    if not quarantined.any():
        return Output(rows)
    columns = {name: rows[name].filter(pa.array(quarantined)) for name in rows.column_names}
    quarantine_rows = QUARANTINE.build(
        {**columns, "determinant": sources.determinant(kappa, gamma1, gamma2)[quarantined]}
    )
    name = quarantine_file(facts["generation_cells"])
    return Output(
        rows.filter(pa.array(~quarantined)), {name: lambda path: parquet.write(path, quarantine_rows, QUARANTINE)}
    )


def _universe(facts: Json, user_inputs: Ingest | None = None) -> GalaxyModel:
    light_cone, training = _load_external(facts, user_inputs)
    return galaxies.model(facts["seed"], _universe_section(facts, _GALAXY_FACTS), light_cone, training)


def _universe_section(facts: Json, names: Sequence[str]) -> Universe:
    # The list of JSON becomes a tuple, because models are kept by their settings.
    settings: dict[str, Any] = {name: facts[name] for name in ("galaxy_band", *names)}
    if settings.get("lensing") is not None:
        settings["lensing"] = tuple(settings["lensing"])
    settings["cosmology"] = from_facts(facts)
    if "high_redshift_boost" in names:
        settings["variables"] = facts.get("variables", False)
    _refuse_other_camb(settings["cosmology"], facts.get("camb", ""))
    return Universe(**settings)


def _refuse_other_camb(cosmology: Cosmology, planned: str) -> None:
    """Raise BadInput if this process has another version of CAMB than the driver, because its spectrum would differ."""
    version = boltzmann.camb_version(cosmology)
    if version != planned:
        problem = f"this worker has CAMB {version or 'none'}, and the driver has {planned or 'none'}"
        raise BadInput(f"universe.cosmology: {problem}: install the same version on all computers")


def _load_external(facts: Json, user_inputs: Ingest | None) -> tuple[LightCone | None, Training | None]:
    """Return the user's halos and the user's training galaxies; each is None if the request names no files of them."""
    light_cone = training = None
    if user_inputs is not None and user_inputs.halos is not None:
        columns = mapping.halo_columns(dict(user_inputs.halos.columns), from_facts(facts))
        files, _ = ingest.list_files(user_inputs.halos.files, columns)
        light_cone = halo_catalogue.load(files, facts["halos"]["sha256"], columns)
    if user_inputs is not None and user_inputs.training is not None:
        columns = mapping.training_columns(dict(user_inputs.training.columns), from_facts(facts))
        files, _ = ingest.list_files(user_inputs.training.files, columns)
        training = nearest_sed.load(files, facts["training"]["sha256"], columns)
    return light_cone, training


def _input_facts(catalogue: Catalogue, columns: mapping.Columns) -> Json:
    return {"sha256": ingest.files_with_checksums(catalogue.files, columns)[1], "columns": dict(catalogue.columns)}


def _ingest_step(lake: Path, request: Request, catalogue: Catalogue) -> Step:
    columns = ingest.galaxy_columns(catalogue, request.universe.lensing is not None, request.universe.cosmology)
    files, sha256 = ingest.files_with_checksums(catalogue.files, columns)
    catalogue_facts = {"sha256": sha256, "format": catalogue.format, "columns": dict(catalogue.columns)}
    dust = request.ingest.dust
    facts = {
        "seed": request.seed,
        "ingest": catalogue_facts,
        **_lens_facts(request),
        **dust_map.facts(dust),
        "code": code_version(),
    }
    plan = Plan(GALAXIES, facts, cells.tasks_of_area(request.area))
    if not layout.version_folder(lake, GALAXIES.name, plan.key).exists():
        ingest.split_by_cell(files, sha256, columns)
    return Step(plan, partial(ingest_galaxies, catalogue=catalogue, dust=dust))


def _lens_facts(request: Request) -> Json:
    universe = request.facts("universe")["universe"]
    return {name: universe[name] for name in (*_LENS_FACTS, "cosmology")}


def _given_step(request: Request, source_tables: UserSources) -> Step:
    source_facts = source_tables.facts(request.area.bounding_circle())
    given_sources.load(source_tables, request.area, request.universe.cosmology)
    plan = Plan(
        GALAXIES,
        {"seed": request.seed, "sources": source_facts, **_lens_facts(request), "code": code_version()},
        cells.tasks_of_area(request.area),
    )
    return Step(plan, partial(draw_given_galaxies, source_tables=source_tables, area=request.area))


def draw_given_galaxies(lake: Path, facts: Json, source_tables: UserSources, area: Area) -> Output:
    """Make the galaxies in one order-5 cell for a request whose sources are all listed in tables of the user.

    Parameters
    ----------
    lake : Path
        Not used.
    facts : dict
        Parameters of the job and of the task; `generation_cells` are the order-8 cells to draw.
    source_tables : UserSources
        The user's tables of stars and galaxies.
    area : Area
        Area of the request.

    Returns
    -------
    Output
        Rows of table `galaxies`. Galaxies too close to a caustic are in an additional file for the table `quarantine`.
    """
    cosmology = from_facts(facts)
    source_columns = given_sources.load(source_tables, area, cosmology, facts["sources"])
    model = given_sources.model(
        facts["seed"], source_tables, source_columns, cosmology, _shear(facts), facts["rotation"]
    )
    return _split_quarantine(
        facts, cells.draw_rows(facts, GALAXIES, lambda cell: given_sources.galaxies(cell, source_columns, model))
    )


def _shear(facts: Json) -> Shear | None:
    return None if facts["lensing"] is None else Shear(*facts["lensing"])


def ingest_galaxies(lake: Path, facts: Json, catalogue: Catalogue, dust: DustMap | None) -> Output:
    """Convert the galaxies of a user's catalogue in the requested order-8 cells inside one order-5 cell.

    Parameters
    ----------
    lake : Path
        Not used.
    facts : dict
        Parameters of the job and of the task; `generation_cells` are the order-8 cells to convert.
    catalogue : Catalogue
        Files and columns of the user's catalogue.
    dust : DustMap or None
        The user's dust map; None for the simulated map.

    Returns
    -------
    Output
        Rows of table `galaxies`. Galaxies too close to a caustic are in an additional file for the table `quarantine`.
    """
    columns = ingest.galaxy_columns(catalogue, facts["lensing"] is not None, from_facts(facts))
    files, _ = ingest.list_files(catalogue.files, columns)
    split_catalogue = ingest.split_by_cell(files, facts["ingest"]["sha256"], columns)
    model = from_catalogue.model(facts["seed"], columns, split_catalogue, _shear(facts), facts["rotation"])
    sky_map = dust_map.map_for_request(facts["seed"], dust)

    def draw(cell: int) -> pa.Table:
        return from_catalogue.draw(cell, ingest.rows_of_cell(split_catalogue, cell), model, sky_map)

    return _split_quarantine(facts, cells.draw_rows(facts, GALAXIES, draw))


JOB = Job("build_galaxies", "Draw the halos and galaxies of a sky area.", steps)
