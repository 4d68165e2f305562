"""What catalogues and their fluxes will cost, before they are drawn: rows, CPU seconds and bytes from area and depth.

of_request   a line a job, for the area and depth of a request
of_lake      the same for the catalogues that a lake holds
text         the table that a person reads
"""

from __future__ import annotations

import tomllib
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from lake_schema import sky
from lake_schema.errors import LakeError
from lake_schema.external import rows as external_rows
from lake_schema.ids import FILE_ORDER, GENERATION_ORDER
from lake_schema.store import names, read
from lake_schema.store.object_storage.s3 import Folder
from truesky.render.planning.mission import mission_of
from truesky.render.planning.source_counts import Densities
from truesky.request.area import Area
from truesky.request.files import SOURCES, GivenSources
from truesky.request.schema import MissionChoice, Request, Universe

# Lowest order of a file of stars, as of jobs/catalogue/build_stars.py.
_LARGEST = 3
# Workers that begin a job: those of spark-defaults.conf.
WORKERS = 2
_JOBS = {
    "build_galaxies": ("halos", "galaxies"),
    "build_stars": ("stars",),
    "compute_fluxes": ("galaxy_fluxes", "star_fluxes"),
}
_CATALOGUE = {"galaxy_fluxes": "galaxies", "star_fluxes": "stars"}
_TABLES = ("halos", "galaxies", "stars", *_CATALOGUE)


@dataclass(frozen=True, slots=True)
class Line:
    """One job: rows of its tables, CPU seconds, GB written."""

    job: str
    rows: float
    seconds: float
    gb: float


def of_request(request: Request, factor: float = 1.0) -> list[Line]:
    """The jobs that draw; what an external catalogue holds is not known, and left out; of given sources their number.

    factor : CPU s of the machine that is asked about over those of the channels' costs
    Error  : over an area that no number was chosen on, of rows 3 %, of bytes 2 %, of seconds 5 % (galaxies) to 30 %
             (fluxes), where the cache holds what is computed once a machine
    """
    cells = request.area.cells()
    rows = _drawn(request, cells) if request.sources is None else _given(request.sources, request.area)
    parts = dict.fromkeys(rows, _files(cells, FILE_ORDER))
    if "stars" in rows:
        parts["stars"] = max(_files(cells, _LARGEST), round(rows["stars"] / request.stars.rows_a_file))
    return _lines(rows, parts, dict.fromkeys(_CATALOGUE, len(request.bands)), factor)


def of_lake(lake: Folder, factor: float = 1.0) -> list[Line]:
    """The jobs whose tables a lake holds, by what their manifests say of area and depth.

    Versions of several requests add up; one that requests share is made once.

    factor : as of `of_request`
    """
    found: dict[str, Line] = {}
    counted: set[tuple[str, str]] = set()
    requests: list[str | None] = [*names.names(lake)]
    for request in requests or [None]:
        held = {name: version for name in _TABLES if (version := _held(lake, name, request))}
        new = {(name, version.key) for name, version in held.items()} - counted
        for line in _of_versions(held, factor, {name for name, _ in new}):
            before = found.get(line.job, Line(line.job, 0.0, 0.0, 0.0))
            found[line.job] = Line(
                line.job, before.rows + line.rows, before.seconds + line.seconds, before.gb + line.gb
            )
        counted |= new
    return [found[job] for job in _JOBS if job in found]


def _of_versions(held: Mapping[str, read.Version], factor: float, made: Collection[str]) -> list[Line]:
    rows: dict[str, float] = {}
    bands: dict[str, int] = {}
    for name, version in held.items():
        facts, there = version.manifest["facts"], version.manifest["parts"]
        cells = [cell for part in there for cell in part["facts"].get("generation_cells", ())]
        if name in ("halos", "galaxies") and "galaxy_limit" in facts:
            rows[name] = _galaxies(facts["galaxy_limit"], len(cells))[name]
        if name == "stars" and "star_limit" in facts:
            mission = mission_of(MissionChoice())
            rows[name] = _stars(Densities(mission, Universe(star_limit=facts["star_limit"])), cells)
        bands |= {name: len(facts["bands"])} if "bands" in facts else {}
    parts = {name: len(version.parts) for name, version in held.items()}
    return _lines(rows, parts, bands, factor, made)


def text(lines: Sequence[Line]) -> Iterator[str]:
    """The forecast as lines of text."""
    yield f"{'job':16} {'rows':>15} {'core-hours':>11} {'GB':>10}"
    for line in lines:
        yield f"{line.job:16} {line.rows:15,.0f} {line.seconds / 3600.0:11,.3f} {line.gb:10,.3f}"


def _files(cells: Sequence[int], order: int) -> int:
    return len({cell >> 2 * (GENERATION_ORDER - order) for cell in cells})


def _held(lake: Folder, table: str, request: str | None) -> read.Version | None:
    try:
        return read.published_last(lake, table) if request is None else read.for_request(lake, table, request)
    except LakeError:
        return None


def _drawn(request: Request, cells: Sequence[int]) -> dict[str, float]:
    """Rows of each catalogue that is drawn."""
    rows = {} if request.ingest.galaxies else _galaxies(request.universe.galaxy_limit, len(cells))
    if request.stars.catalogue is None:
        mission, universe, brightest = mission_of(request.mission), request.universe, request.stars.bright_limit
        rows["stars"] = _stars(Densities(mission, universe), cells)
        if brightest is not None:
            rows["stars"] -= _stars(Densities(mission, replace(universe, star_limit=brightest)), cells)
    return rows


def _given(own: GivenSources, area: Area) -> dict[str, float]:
    """Rows of the tables, or on a grid as many as the circle about the area has places for."""
    files = {"galaxies": own.galaxies, "stars": own.stars}
    rows = {name: float(_rows_of(file)) for name, file in files.items() if file is not None}
    if own.spacing:
        radius = np.radians(area.bounds()[2])
        places = 4.0 * np.pi * np.sin(0.5 * radius) ** 2 / np.radians(own.spacing / 3600.0) ** 2
        total = sum(rows.values())
        rows = {name: max(1.0, places * number / total) for name, number in rows.items()}
    return rows


def _rows_of(file: Path) -> int:
    title = external_rows.titles(file, SOURCES)[0]
    return sum(len(piece.columns[title]) for piece in external_rows.pieces(file, [title], kind=SOURCES))


def _galaxies(limit: float, cells: int) -> dict[str, float]:
    """Halos and galaxies that are drawn in so many generation cells."""
    drawn, area = _costs()["drawn"], cells * sky.cell_area(GENERATION_ORDER)
    at = np.array(drawn["limits"])
    # Beyond the limits, as between the two that are nearest.
    i = int(np.clip(np.searchsorted(at, limit) - 1, 0, at.size - 2))
    s = (limit - at[i]) / (at[i + 1] - at[i])
    logs = {name: np.log(drawn[name]) for name in ("halos", "galaxies")}
    return {name: area * float(np.exp((1 - s) * log[i] + s * log[i + 1])) for name, log in logs.items()}


def _stars(densities: Densities, cells: Sequence[int]) -> float:
    """Stars of generation cells, by the published counts."""
    if not cells:
        return 0.0
    return float(densities.at(*sky.cell_centres(GENERATION_ORDER, cells))[1].sum() * sky.cell_area(GENERATION_ORDER))


def _lines(
    rows: Mapping[str, float],
    parts: Mapping[str, int],
    bands: Mapping[str, int],
    factor: float,
    made: Collection[str] = _TABLES,
) -> list[Line]:
    """A line a job; made : the tables that it makes, of others the rows count alone where they are its input."""
    lines = []
    for job, tables in _JOBS.items():
        seconds = size = number = 0.0
        for table in tables:
            catalogue = _CATALOGUE.get(table, table)
            if table not in made or catalogue not in rows or (table in _CATALOGUE and table not in bands):
                continue
            cost, n, in_bands = _costs()[table], parts.get(table, parts[catalogue]), bands.get(table, 1)
            number += rows[catalogue]
            seconds += cost["start_s"] + min(n, WORKERS) * cost["worker_s"] + n * cost["part_s"]
            seconds += rows[catalogue] * in_bands * cost["row_s"]
            size += cost["start_bytes"] + rows[catalogue] * (cost["row_bytes"] + in_bands * cost["band_bytes"])
        if number:
            lines.append(Line(job, number, factor * seconds, size / 1e9))
    return lines


@cache
def _costs() -> dict[str, Any]:
    return tomllib.loads((files("truesky.render.forecasting") / "catalogue_costs.toml").read_text(encoding="utf-8"))
