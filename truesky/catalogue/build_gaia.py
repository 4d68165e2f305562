"""Build the table `gaia`, the simulated Gaia catalogue of the stars.

Command: spark-submit jobs/catalogue/build_gaia.py --lake LAKE --request REQUEST.

The key `fluxes.bands` of the request must contain gaia_g, gaia_bp and gaia_rp.
"""

from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from lake_schema import sky
from lake_schema.errors import BadInput
from lake_schema.store import layout, read
from lake_schema.store.plan import Json, Output, Plan, Task
from lake_schema.store.provenance import code_version
from lake_schema.tables.gaia import GAIA, with_variable_flag
from truesky.catalogue.stars import gaia
from truesky.request import universe
from truesky.request.schema import Request
from truesky.running.submitted_job import Job, Step


def steps(lake: Path, request: Request) -> list[Step]:
    """Plan the making of table `gaia`, with one task per partition (file) of the stars.

    Parameters
    ----------
    lake : Path
        Folder of the lake.
    request : Request
        The request; its tables `stars` and `star_fluxes` must be in the lake.

    Returns
    -------
    list of Step
        One step, which simulates the measurements.

    Raises
    ------
    BadInput
        If the Gaia bands are missing in the table `star_fluxes`, or if this table was computed from other rows of
        `stars`.
    """
    stars, fluxes = (read.input_version(lake, name, request.name) for name in ("stars", "star_fluxes"))
    universe.check_catalogues([stars], request)
    if missing := [name for name in gaia.FLUX_COLUMNS if name not in fluxes.schema.names]:
        raise BadInput(
            f"table star_fluxes has no column {', '.join(missing)}: put {', '.join(gaia.BANDS)} into fluxes.bands and "
            "run truesky fluxes"
        )
    if fluxes.manifest["facts"].get("input") != stars.key:
        raise BadInput("table star_fluxes was computed from another version of stars: run truesky fluxes first")
    facts = {"seed": request.seed, "stars": stars.key, "star_fluxes": fluxes.key, "code": code_version()}
    tasks = tuple(Task(name, {"part": name}) for name in stars.partitions)
    declared = with_variable_flag(GAIA) if "variability" in stars.schema.names else GAIA
    return [Step(Plan(declared, facts, tasks), observe_stars)]


def observe_stars(lake: Path, facts: Json) -> Output:
    """Draw Gaia's measurements of the stars in one partition.

    Parameters
    ----------
    lake : Path
        Folder of the lake.
    facts : dict
        Parameters of the job and of the task; `part` is the name of the partition.

    Returns
    -------
    Output
        Rows of table `gaia` whose measured positions are in the sky cell of the partition.

    Notes
    -----
    Stars in the margin (a strip around the cell) are also observed, because their measured positions may be inside the
    cell.
    """
    partition = facts["part"]
    version = read.version(lake, "stars", facts["stars"])
    variable_columns = [name for name in gaia.VARIABLE_COLUMNS if name in version.schema.names]
    stars = _rows(version, partition, [*gaia.STAR_COLUMNS, *variable_columns])
    fluxes = _rows(read.version(lake, "star_fluxes", facts["star_fluxes"]), partition, gaia.FLUX_COLUMNS)
    rows = gaia.observe(stars, fluxes, facts["seed"])
    first, last = sky.cell_range(*layout.cell_of_file(partition))
    index = rows["_healpix_29"]
    return Output(rows.filter(pc.and_(pc.greater_equal(index, first), pc.less(index, last))))


def _rows(version: read.Version, partition: str, columns: list[str]) -> pa.Table:
    return pa.concat_tables([version.rows(columns, [partition]), version.read_margin(partition, columns)])


JOB = Job("build_gaia", "Draw Gaia's measurements of the stars.", steps)
