"""Forecast the table rows, CPU seconds and bytes of simulated catalogues from their area and magnitude limit.

The catalogues are dark-matter halos, galaxies and stars, and the tables of their fluxes.
"""

from __future__ import annotations

import tomllib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from lake_schema import sky
from lake_schema.errors import LakeError
from lake_schema.ids import FILE_ORDER, GENERATION_ORDER
from lake_schema.store import read, request_links
from lake_schema.store.object_storage.s3 import Folder
from truesky.render.planning.mission import mission_of
from truesky.render.planning.source_counts import Densities, euclid_limit
from truesky.request.area import Area
from truesky.request.files import UserSources
from truesky.request.schema import MissionChoice, Request, Universe

# HEALPix order of the largest cells that a file of the table `stars` covers (truesky/catalogue/build_stars.py).
_LOWEST_STAR_ORDER = 3
# Number of Spark workers (processes) of a job, as in spark-defaults.conf. Each needs CPU time to start.
WORKERS = 2
# Names of the catalogue tables that each job makes.
_TABLES_OF_JOB = {
    "build_galaxies": ("halos", "galaxies"),
    "build_stars": ("stars",),
    "build_transients": ("transients",),
    "compute_fluxes": ("galaxy_fluxes", "star_fluxes"),
}
_CATALOGUE_OF_FLUXES = {"galaxy_fluxes": "galaxies", "star_fluxes": "stars"}
_TABLES = ("halos", "galaxies", "stars", "transients", *_CATALOGUE_OF_FLUXES)


@dataclass(frozen=True, slots=True)
class Line:
    """Forecast of the rows, CPU time and file size of a job that makes catalogues.

    Attributes
    ----------
    job : str
        Name of the job, such as "build_stars".
    rows : float
        Number of rows that it writes, summed over its tables.
    seconds : float
        CPU seconds of the reference machine, multiplied by the factor that was given for this machine.
    gb : float
        Size of the files that it writes, in GB.
    wall_s : float
        Wall seconds, if `WORKERS` processes run the tasks.
    """

    job: str
    rows: float
    seconds: float
    gb: float
    wall_s: float


def for_request(request: Request, factor: float = 1.0) -> list[Line]:
    """Forecast rows, CPU time and file size of the jobs that make the catalogues of a request, one line per job.

    `factor` is the CPU time of this machine relative to the reference machine, on which the costs were measured.
    The user's catalogues of galaxies and of stars are left out, because their number of rows is not known. If the user
    gives halos, the forecast is that for halos drawn by truesky. The rows of the user's tables of sources are counted.

    Notes
    -----
    In a test area, errors were 3 % for rows and 2 % for bytes. Errors of seconds were 5 % (galaxies) to 30 % (fluxes),
    if the disc cache contains the results that each machine computes only once.
    """
    cells = request.area.cells()
    rows = _drawn_rows(request, cells) if request.sources is None else _given_rows(request.sources, request.area)
    transients = request.transients
    if transients is not None and "galaxies" in rows and request.sources is None:
        window = asdict(transients)
        rows["transients"] = _transient_count(euclid_limit(request.universe), len(cells), window)
    partition_counts = dict.fromkeys(rows, _file_count(cells, FILE_ORDER))
    if "stars" in rows:
        partition_counts["stars"] = max(
            _file_count(cells, _LOWEST_STAR_ORDER), round(rows["stars"] / request.stars.rows_a_file)
        )
    return _make_lines(rows, partition_counts, dict.fromkeys(_CATALOGUE_OF_FLUXES, len(request.bands)), factor)


def for_lake(lake: Folder, factor: float = 1.0) -> list[Line]:
    """Forecast rows, CPU time and file size of the jobs that made the catalogues of a lake (folder of stored tables).

    The forecast is for comparison with the logs of these jobs. Area and magnitude limit come from the manifests (stored
    descriptions) of the tables; missing tables are left out. The tables of several requests add up, and a table that
    requests share is counted once. `factor` is the CPU time of this machine relative to the reference machine.
    """
    line_of_job: dict[str, Line] = {}
    counted: set[tuple[str, str]] = set()
    requests: list[str | None] = [*request_links.request_names(lake)]
    for request in requests or [None]:
        versions = {name: version for name in _TABLES if (version := _find_version(lake, name, request))}
        new = {(name, version.key) for name, version in versions.items()} - counted
        for line in _forecast_versions(versions, factor, {name for name, _ in new}):
            total = line_of_job.get(line.job, Line(line.job, 0.0, 0.0, 0.0, 0.0))
            line_of_job[line.job] = Line(
                line.job,
                total.rows + line.rows,
                total.seconds + line.seconds,
                total.gb + line.gb,
                total.wall_s + line.wall_s,
            )
        counted |= new
    return [line_of_job[job] for job in _TABLES_OF_JOB if job in line_of_job]


def _forecast_versions(versions: Mapping[str, read.Version], factor: float, new_tables: Collection[str]) -> list[Line]:
    rows: dict[str, float] = {}
    bands: dict[str, int] = {}
    for name, version in versions.items():
        facts, partitions = version.manifest["facts"], version.manifest["parts"]
        cells = [cell for partition in partitions for cell in partition["facts"].get("generation_cells", ())]
        if name in ("halos", "galaxies") and "galaxy_limit" in facts:
            limits = {key: facts[key] for key in ("galaxy_limit", "galaxy_band") if key in facts}
            rows[name] = _galaxy_counts(euclid_limit(Universe(**limits)), len(cells))[name]
        if name == "stars" and "star_limit" in facts:
            mission = mission_of(MissionChoice())
            rows[name] = _star_count(Densities(mission, Universe(star_limit=facts["star_limit"])), cells)
        bands |= {name: len(facts["bands"])} if "bands" in facts else {}
    if "transients" in versions and "galaxies" in rows:
        cells = [
            cell for part in versions["transients"].manifest["parts"] for cell in part["facts"]["generation_cells"]
        ]
        galaxy_facts = versions["galaxies"].manifest["facts"]
        limits = {key: galaxy_facts[key] for key in ("galaxy_limit", "galaxy_band") if key in galaxy_facts}
        window = versions["transients"].manifest["facts"]
        rows["transients"] = _transient_count(euclid_limit(Universe(**limits)), len(cells), window)
    partition_counts = {name: len(version.partitions) for name, version in versions.items()}
    return _make_lines(rows, partition_counts, bands, factor, new_tables)


def _file_count(cells: Sequence[int], order: int) -> int:
    return len({cell >> 2 * (GENERATION_ORDER - order) for cell in cells})


def _find_version(lake: Folder, table: str, request: str | None) -> read.Version | None:
    try:
        return read.latest_version(lake, table) if request is None else read.input_version(lake, table, request)
    except LakeError:
        return None


def _drawn_rows(request: Request, cells: Sequence[int]) -> dict[str, float]:
    """Return the expected number of rows, by table name, of the catalogues that truesky draws at random.

    `cells` are the order-8 HEALPix cells of the request's area.
    """
    rows = {} if request.ingest.galaxies else _galaxy_counts(euclid_limit(request.universe), len(cells))
    if request.stars.catalogue is None:
        mission, universe, brightest = mission_of(request.mission), request.universe, request.stars.bright_limit
        rows["stars"] = _star_count(Densities(mission, universe), cells)
        if brightest is not None:
            rows["stars"] -= _star_count(Densities(mission, replace(universe, star_limit=brightest)), cells)
    return rows


def _given_rows(sources: UserSources, area: Area) -> dict[str, float]:
    """Return the number of rows that the user's own tables of sources give, by table name.

    If the sources are placed on a grid, it is the number of grid points in the circle around the area, divided in
    proportion to the rows of the tables.
    """
    rows = {name: float(count) for name, count in sources.count_rows().items()}
    if sources.spacing:
        radius = np.radians(area.bounding_circle()[2])
        places = 4.0 * np.pi * np.sin(0.5 * radius) ** 2 / np.radians(sources.spacing / 3600.0) ** 2
        total = sum(rows.values())
        rows = {name: max(1.0, places * number / total) for name, number in rows.items()}
    return rows


def _galaxy_counts(limit: float, cells: int) -> dict[str, float]:
    """Return the expected numbers of halos and galaxies brighter than a limit in I_E in `cells` order-8 cells.

    The numbers are means over the sky; a limit outside the tabulated ones is extrapolated.
    """
    table, area = _costs()["drawn"], cells * sky.cell_area(GENERATION_ORDER)
    limits = np.array(table["limits"])
    # Interpolate between the two nearest magnitude limits of the table, or extrapolate from them outside the table.
    i = int(np.clip(np.searchsorted(limits, limit) - 1, 0, limits.size - 2))
    s = (limit - limits[i]) / (limits[i + 1] - limits[i])
    logs = {name: np.log(table[name]) for name in ("halos", "galaxies")}
    return {name: area * float(np.exp((1 - s) * log[i] + s * log[i + 1])) for name, log in logs.items()}


def _transient_count(limit: float, cells: int, window: Mapping[str, Any]) -> float:
    """Return the expected number of supernovae in galaxies brighter than a limit in I_E in `cells` order-8 cells.

    `window` has the first and last date `start` and `end` (MJD), the `kinds` of supernovae and the `boost` of the rate.
    """
    table, area = _costs()["drawn"], cells * sky.cell_area(GENERATION_ORDER)
    a_day, days = (
        float(np.interp(limit, table["limits"], values))
        for values in (np.sum([table[kind] for kind in window["kinds"]], axis=0), table["days"])
    )
    return float(area * a_day * window["boost"] * (window["end"] - window["start"] + days))


def _star_count(densities: Densities, cells: Sequence[int]) -> float:
    """Return the expected number of stars in order-8 HEALPix cells, given the densities of stars on the sky."""
    if not cells:
        return 0.0
    return float(densities.at(*sky.cell_centres(GENERATION_ORDER, cells))[1].sum() * sky.cell_area(GENERATION_ORDER))


def _make_lines(
    rows: Mapping[str, float],
    partition_counts: Mapping[str, int],
    bands: Mapping[str, int],
    factor: float,
    new_tables: Collection[str] = _TABLES,
) -> list[Line]:
    """Return the forecast (rows, CPU time, file size) of each job that makes tables in `new_tables`.

    Jobs without rows are left out. `rows` and `partition_counts` have the numbers of rows and of files of each table,
    and `bands` the number of bands of each table of fluxes, by table name. `factor` is the CPU time of this machine
    relative to the reference machine.
    """
    lines = []
    for job, tables in _TABLES_OF_JOB.items():
        serial = parallel = wall = size = row_count = 0.0
        for table in tables:
            catalogue = _CATALOGUE_OF_FLUXES.get(table, table)
            if (
                table not in new_tables
                or catalogue not in rows
                or (table in _CATALOGUE_OF_FLUXES and table not in bands)
            ):
                continue
            cost, n, in_bands = (
                _costs()[table],
                partition_counts.get(table, partition_counts[catalogue]),
                bands.get(table, 1),
            )
            used = min(n, WORKERS)
            in_workers = used * cost["worker_s"] + n * cost["part_s"] + rows[catalogue] * in_bands * cost["row_s"]
            row_count += rows[catalogue]
            serial += cost["start_s"]
            parallel += in_workers
            wall += in_workers / max(used, 1)
            size += cost["start_bytes"] + rows[catalogue] * (cost["row_bytes"] + in_bands * cost["band_bytes"])
        if row_count:
            lines.append(Line(job, row_count, factor * (serial + parallel), size / 1e9, factor * (serial + wall)))
    return lines


@cache
def _costs() -> dict[str, Any]:
    return tomllib.loads((files("truesky.render.forecasting") / "catalogue_costs.toml").read_text(encoding="utf-8"))
