"""Build tables `halos`, `halo_limits`, `galaxies` and `quarantine` of a request.

spark-submit jobs/catalogue/build_galaxies.py --lake LAKE --request REQUEST
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import pyarrow as pa

from lake_schema.ids import FILE_ORDER, GENERATION_ORDER
from lake_schema.store import layout, parquet, read
from lake_schema.store.plan import Json, Output, Part, Plan
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
from truesky.catalogue.request_checks import check_band
from truesky.fluxes import sources
from truesky.request.area import Area
from truesky.request.checks import check_rendered
from truesky.request.files import Catalogue, DustMap, GivenSources, Ingest
from truesky.request.schema import Request, Universe
from truesky.running.shell import Job, Step

_HALO_FACTS = ("galaxy_limit", "z_max", "box_cells")
_LENS_FACTS = ("lensing", "rotation")
_GALAXY_FACTS = (*_HALO_FACTS, "lensing_nside", "alignment", *_LENS_FACTS, "high_redshift_boost", "quasar_boost")


def steps(lake: Path, request: Request) -> list[Step]:
    """Tables of one part an order-5 cell each, made of the generation cells that the request's area touches.

    Galaxies of a finished catalogue have no table of halos: these are not known. Galaxies that weak lensing cannot
    describe lie in files beside the others, and are a table of their own.
    """
    check_rendered(request)
    # Whatever is wrong with a file is said before anything is published.
    dust_map.chosen(request.seed, request.ingest.dust)
    if request.sources is not None:
        made = [_given(request, request.sources)]
    elif request.ingest.galaxies is not None:
        made = [_ingested(lake, request, request.ingest.galaxies)]
    else:
        made = _drawn(lake, request)
    facts = {"galaxies": made[-1].plan.key, "code": code_version()}
    apart = Plan(QUARANTINE, facts, (Part("all.parquet", {}),))
    return [*made, Step(apart, quarantine_work, on_driver=True)]


def _drawn(lake: Path, request: Request) -> list[Step]:
    universe = request.facts("universe")["universe"]
    del universe["star_limit"]
    own = request.ingest
    check_band(request)
    # The spectra of a training table say how faint a halo's galaxy may be.
    theirs = {"halos": _about(own.halos, mapping.halos(dict(own.halos.columns)))} if own.halos else {}
    theirs |= {"training": _about(own.training, mapping.training(dict(own.training.columns)))} if own.training else {}
    facts = {"seed": request.seed, **universe, **theirs, **dust_map.facts(own.dust), "code": code_version()}
    parts = cells.parts(request.area)
    of_halos = {key: facts[key] for key in ("seed", *_HALO_FACTS, "galaxy_band", *theirs, "code")}
    halos, limits = Plan(HALOS, of_halos, parts), Plan(HALO_LIMITS, of_halos, (Part("all.parquet", {}),))
    # Up to this multipole the lensing has the power of linear theory within 10 %.
    reach = {"lensing_l_max": facts["lensing_nside"]} if request.universe.lensing is None else {}
    plan = Plan(GALAXIES, {**facts, **reach}, parts)
    if not layout.version(lake, GALAXIES.name, plan.key).exists():
        # The box and its lensing are made here, once, and only mapped by the workers.
        _universe(facts, own)
    return [
        Step(halos, partial(halo_work, own=own)),
        Step(limits, partial(limit_work, own=own), on_driver=True),
        Step(plan, partial(work, own=own)),
    ]


def halo_work(lake: Path, facts: Json, own: Ingest | None = None) -> Output:
    """The halos of one order-5 cell."""
    light_cone, training = _external(facts, own)
    found = galaxies.halos_and_galaxies(facts["seed"], _wanted(facts, _HALO_FACTS), light_cone, training)
    drawn = population.Cells(found)
    return Output(cells.rows(facts, HALOS, lambda cell: galaxies.halo_table(cell, found, drawn)))


def limit_work(lake: Path, facts: Json, own: Ingest | None = None) -> Output:
    """From which mass on all halos are listed."""
    light_cone, training = _external(facts, own)
    found = galaxies.halos_and_galaxies(facts["seed"], _wanted(facts, _HALO_FACTS), light_cone, training)
    return Output(galaxies.halo_limits(found))


def work(lake: Path, facts: Json, own: Ingest | None = None) -> Output:
    """The galaxies that are seen in one order-5 cell."""
    universe = _universe(facts, own)
    dust = dust_map.chosen(facts["seed"], own.dust if own else None)
    drawn = population.Cells(universe.population)
    return _parted(facts, observed_cells.draw(facts["generation_cells"], universe, drawn, dust))


def quarantine_work(lake: Path, facts: Json) -> Output:
    """What lies beside the galaxies of all cells."""
    version = read.version(lake, GALAXIES.name, facts["galaxies"])
    there = {entry["path"] for entry in version.manifest["files"]}
    names = (quarantine_file(part["facts"]["generation_cells"]) for part in version.manifest["parts"])
    found = [version.beside(name) for name in names if name in there]
    return Output(pa.concat_tables([QUARANTINE.empty(), *found]))


def quarantine_file(generation_cells: Sequence[int]) -> str:
    """Where a version of `galaxies` keeps what weak lensing cannot describe; not there where nothing is."""
    return f"quarantine/{layout.cell_file(FILE_ORDER, generation_cells[0] >> 2 * (GENERATION_ORDER - FILE_ORDER))}"


def _parted(facts: Json, rows: pa.Table) -> Output:
    kappa, gamma1, gamma2 = (rows[name].to_numpy().astype(float) for name in ("kappa", "gamma1", "gamma2"))
    apart = lensing.near_caustic(kappa, gamma1, gamma2, lensing.settings().caustic)
    if not apart.any():
        return Output(rows)
    given = {name: rows[name].filter(pa.array(apart)) for name in rows.column_names}
    found = QUARANTINE.build({**given, "determinant": sources.determinant(kappa, gamma1, gamma2)[apart]})
    name = quarantine_file(facts["generation_cells"])
    return Output(rows.filter(pa.array(~apart)), {name: lambda path: parquet.write(path, found, QUARANTINE)})


def _universe(facts: Json, own: Ingest | None = None) -> GalaxyModel:
    light_cone, training = _external(facts, own)
    return galaxies.model(facts["seed"], _wanted(facts, _GALAXY_FACTS), light_cone, training)


def _wanted(facts: Json, names: Sequence[str]) -> Universe:
    return Universe(**{name: facts[name] for name in ("galaxy_band", *names)})


def _external(facts: Json, own: Ingest | None) -> tuple[LightCone | None, Training | None]:
    """The user's halos and observed galaxies, where the request names some."""
    light_cone = training = None
    if own is not None and own.halos is not None:
        columns = mapping.halos(dict(own.halos.columns))
        found, _ = ingest.listed(own.halos.files, columns)
        light_cone = halo_catalogue.load(found, facts["halos"]["sha256"], columns)
    if own is not None and own.training is not None:
        columns = mapping.training(dict(own.training.columns))
        found, _ = ingest.listed(own.training.files, columns)
        training = nearest_sed.load(found, facts["training"]["sha256"], columns)
    return light_cone, training


def _about(given: Catalogue, columns: mapping.Columns) -> Json:
    return {"sha256": ingest.files(given.files, columns)[1], "columns": dict(given.columns)}


def _ingested(lake: Path, request: Request, given: Catalogue) -> Step:
    columns = _columns(given, request.universe.lensing is not None)
    found, sha256 = ingest.files(given.files, columns)
    about = {"sha256": sha256, "format": given.format, "columns": dict(given.columns)}
    dust = request.ingest.dust
    universe = request.facts("universe")["universe"]
    controlled = {name: universe[name] for name in _LENS_FACTS}
    facts = {"seed": request.seed, "ingest": about, **controlled, **dust_map.facts(dust), "code": code_version()}
    plan = Plan(GALAXIES, facts, cells.parts(request.area))
    if not layout.version(lake, GALAXIES.name, plan.key).exists():
        ingest.split(found, sha256, columns)
    return Step(plan, partial(ingested_work, given=given, dust=dust))


def _columns(given: Catalogue, is_lensed_anew: bool) -> mapping.Columns:
    """The mapping of a catalogue, which is seen where it says; where it is, if a request lenses it in another way."""
    columns = mapping.galaxies(given.format, dict(given.columns))
    return mapping.unlensed(columns) if is_lensed_anew else columns


def _given(request: Request, own: GivenSources) -> Step:
    universe = request.facts("universe")["universe"]
    controlled = {name: universe[name] for name in _LENS_FACTS}
    about = own.facts(request.area.bounds())
    given_sources.load(own, request.area)
    plan = Plan(
        GALAXIES,
        {"seed": request.seed, "sources": about, **controlled, "code": code_version()},
        cells.parts(request.area),
    )
    return Step(plan, partial(given_work, own=own, area=request.area))


def given_work(lake: Path, facts: Json, own: GivenSources, area: Area) -> Output:
    """The galaxies of a request that names them all, of one order-5 cell.

    lake  : not used;  facts : of the part
    own   : the tables;  area : of the request
    """
    given = given_sources.load(own, area, facts["sources"])
    model = given_sources.model(facts["seed"], own, given, _shear(facts), facts["rotation"])
    return _parted(facts, cells.rows(facts, GALAXIES, lambda cell: given_sources.galaxies(cell, given, model)))


def _shear(facts: Json) -> Shear | None:
    return None if facts["lensing"] is None else Shear(*facts["lensing"])


def ingested_work(lake: Path, facts: Json, given: Catalogue, dust: DustMap | None) -> Output:
    """A catalogue's galaxies of one order-5 cell.

    lake  : folder of the lake;  facts : of the plan and of the part, which has its cell
    given : the catalogue's files and columns;  dust : an external map of dust, None = the embedded one
    """
    columns = _columns(given, facts["lensing"] is not None)
    found, _ = ingest.listed(given.files, columns)
    laid_out = ingest.split(found, facts["ingest"]["sha256"], columns)
    model = from_catalogue.model(facts["seed"], columns, laid_out, _shear(facts), facts["rotation"])
    sky_map = dust_map.chosen(facts["seed"], dust)

    def draw(cell: int) -> pa.Table:
        return from_catalogue.draw(cell, ingest.rows(laid_out, cell), model, sky_map)

    return _parted(facts, cells.rows(facts, GALAXIES, draw))


JOB = Job("build_galaxies", "Draw the halos and galaxies of a sky area.", steps)
