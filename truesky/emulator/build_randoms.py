"""Build the table `randoms` of a request: random points in the area that a band covers.

Command: spark-submit jobs/catalogue/build_randoms.py --lake LAKE --request REQUEST --density 30 --band euclid_vis.

With --model and --magnitude, each point has the probability that a galaxy of this magnitude is detected there.
"""

from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.compute as pc

from lake_schema import arguments, sky, user_files
from lake_schema.arrays import Float, Int
from lake_schema.errors import BadInput
from lake_schema.ids import FILE_ORDER, GENERATION_ORDER
from lake_schema.store import layout, read
from lake_schema.store.plan import Json, Output, Plan
from lake_schema.store.provenance import code_version
from lake_schema.tables.survey.depth import ORDER
from lake_schema.tables.survey.randoms import RANDOMS
from lake_schema.texts.amounts import format_size
from truesky.catalogue import cells
from truesky.command_line.simulation import RANDOM_LISTS, RANDOM_NUMBERS, RANDOM_TEXTS
from truesky.emulator.model import Model, read_model
from truesky.request.schema import Request
from truesky.running.submitted_job import Job, Step
from truesky.survey_maps import random_points
from truesky.survey_maps.depth_lookup import read_depth_map

# Smallest and largest number of points per arcmin2. Beyond, a file would have no points or not fit into the memory.
MIN_DENSITY, MAX_DENSITY = 1e-3, 1e4
# Smallest and largest AB magnitude of the galaxies whose detection is given.
MIN_MAGNITUDE, MAX_MAGNITUDE = 0.0, 40.0
# Largest expected number of points in a file, unless a cell of order 8 has more.
_ROWS_A_FILE = 1_000_000
# Size of a row in a file in bytes, measured with 30 points per arcmin2. Denser points take less.
_ROW_BYTES = 20.0


def steps(lake: Path, request: Request) -> list[Step]:
    """Plan the making of table `randoms`, in files with similar numbers of points.

    Parameters
    ----------
    lake : Path
        Folder of the lake.
    request : Request
        The request, whose table `depth` must be in the lake.

    Returns
    -------
    list of Step
        One step, which draws the points.

    Raises
    ------
    BadInput
        If the band has no depth, no area of the request is covered, the density is out of range, or the points would
        fill the disc; if the model is damaged, is one of another band, or comes without a magnitude.
    """
    density = arguments.check_number("density", request.density, MIN_DENSITY, MAX_DENSITY, "per arcmin2")
    if layout.current_key(lake, "depth") is None:
        raise BadInput(f"lake {lake} has no table depth: run truesky depth REQUEST {lake} first")
    depth = read.input_version(lake, "depth", request.name)
    band = _choose_band(depth, request.band)
    observed_cells, covered = _covered_area(depth, band, request)
    numbers = random_points.expected_number(covered, density)
    facts = {"seed": request.seed, "density": density, "band": band, "depth": depth.key, "code": code_version()}
    file = _model_file(request)
    if file is not None:
        facts |= {"model": _read_model(file, band).sha256, "magnitude": _magnitude(request)}
    tasks = cells.tasks_by_row_count(observed_cells.tolist(), numbers, _ROWS_A_FILE, FILE_ORDER)
    plan = Plan(RANDOMS, facts, tasks)
    if not layout.version_folder(lake, RANDOMS.name, plan.key).exists():
        _refuse_full_disc(lake, float(numbers.sum()))
    return [Step(plan, partial(draw_randoms, file))]


def draw_randoms(file: str | None, lake: Path, facts: Json) -> Output:
    """Draw the random points of one task, that is in the requested order-8 cells inside one cell.

    Parameters
    ----------
    file : str or None
        File of the model of detection, if there is one.
    lake : Path
        Folder of the lake.
    facts : dict
        Parameters of the job and of the task; `generation_cells` are the order-8 cells to fill.

    Returns
    -------
    Output
        Rows of table `randoms`.

    Raises
    ------
    BadInput
        If the file of the model is not the one of the job's start.
    """
    generation_cells, band = facts["generation_cells"], facts["band"]
    version = read.version(lake, "depth", facts["depth"])
    partitions = _partitions_with(version, generation_cells)
    depth = read_depth_map(version, band, random_points.DEPTH_COLUMNS, partitions)
    detection = None
    if file is not None:
        model = _read_model(file, band)
        if model.sha256 != facts["model"]:
            raise BadInput(
                f"--model {user_files.format_path(Path(file))}: it was replaced during the job; run it again"
            )
        detection = partial(model.detection_probability, facts["magnitude"])
    columns = random_points.draw_points(generation_cells, facts["density"], facts["seed"], depth, detection)
    return Output(RANDOMS.build({**columns, "band": np.full(len(columns["id"]), band, object)}))


def _model_file(request: Request) -> str | None:
    """Return the absolute path of the model of the request, or None; raise BadInput if there are several."""
    if len(request.model) > 1:
        raise BadInput(f"--model has {len(request.model)} files: random points cover one band, so give its model only")
    if not request.model and request.magnitude is not None:
        raise BadInput("--magnitude is of use only with --model: give a file of truesky train, too")
    # Workers may have another current folder.
    return str(Path(request.model[0]).absolute()) if request.model else None


def _magnitude(request: Request) -> float:
    """Return the magnitude of galaxies for the column `detection`; raise BadInput if it is missing or out of range."""
    if request.magnitude is None:
        raise BadInput("--magnitude is missing: --model gives the detection of galaxies of one magnitude")
    return arguments.check_number("magnitude", request.magnitude, MIN_MAGNITUDE, MAX_MAGNITUDE, "mag")


def _read_model(file: str, band: str) -> Model:
    """Return the model in a file; raise BadInput if it is one of another band."""
    model = read_model(Path(file))
    if model.band != band:
        raise BadInput(f"--model {user_files.format_path(Path(file))}: it is of band {model.band}, not of {band}")
    return model


def _choose_band(depth: read.Version, band: str | None) -> str:
    """Return the requested band, by default the only one of the table `depth`; raise BadInput if it has no depth."""
    bands: set[str] = set()
    for partition in depth.partitions:
        bands.update(pc.unique(depth.rows(["band"], [partition])["band"]).to_pylist())
        if band in bands:
            return str(band)
    if band is None and len(bands) == 1:
        return bands.pop()
    if not bands:
        raise BadInput("table depth has no rows: no exposure covers any area")
    choices = ", ".join(sorted(bands))
    if band is None:
        raise BadInput(f"--band is missing: table depth has {choices}")
    raise BadInput(f"--band {band}: table depth has only {choices}")


def _covered_area(depth: read.Version, band: str, request: Request) -> tuple[Int, Float]:
    """Return the order-8 cells of the request that a band covers, and their covered area in depth pixels."""
    requested_cells = np.sort(np.array(request.area.cells(), np.int64))
    covered = np.zeros(len(requested_cells))
    for partition in _partitions_with(depth, requested_cells):
        rows = depth.rows(["pixel", "covered"], [partition], pc.field("band") == band)
        cell = sky.parent(rows["pixel"].to_numpy(), ORDER, GENERATION_ORDER)
        at = np.minimum(np.searchsorted(requested_cells, cell), len(requested_cells) - 1)
        inside = requested_cells[at] == cell
        covered += np.bincount(at[inside], rows["covered"].to_numpy()[inside], len(requested_cells))
    is_covered = covered > 0.0
    if not is_covered.any():
        raise BadInput(f"area: no exposure in band {band} covers it, so there is no area for random points")
    return requested_cells[is_covered], covered[is_covered]


def _partitions_with(depth: read.Version, generation_cells: Int | list[int]) -> list[str]:
    """Return the partitions of the table `depth` that contain any of the order-8 cells."""
    names = []
    for partition in depth.partitions:
        order, cell = layout.cell_of_file(partition)
        if (sky.parent(generation_cells, GENERATION_ORDER, order) == cell).any():
            names.append(partition)
    return names


def _refuse_full_disc(lake: Path, number: float) -> None:
    """Raise BadInput if the disc of a lake has no space for a number of random points."""
    free = shutil.disk_usage(next(path for path in (lake, *lake.parents) if path.exists())).free
    if number * _ROW_BYTES > free:
        problem = f"--density: {number:,.0f} random points take {format_size(number * _ROW_BYTES)}"
        raise BadInput(f"{problem}, and {format_size(free)} are free: use a lower density")


JOB = Job(
    "build_randoms",
    "Draw random points in the area that a band covers.",
    steps,
    list_options=RANDOM_LISTS,
    number_options=RANDOM_NUMBERS,
    text_options=RANDOM_TEXTS,
)
