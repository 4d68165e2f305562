"""Build the table `randoms` of a request: random points in the areas that bands cover.

Command: spark-submit jobs/catalogue/build_randoms.py --lake LAKE --request REQUEST --density 30 --band euclid_vis.

With several bands, the table has the points of each band. With --model and --magnitude, each point has the probability
that a galaxy of this magnitude is detected there.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
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
from truesky.command_line.simulation import RANDOM_LISTS, RANDOM_NUMBERS
from truesky.emulator.model import Model, read_model
from truesky.request.schema import Request
from truesky.running.submitted_job import Job, Step
from truesky.survey_maps import random_points
from truesky.survey_maps.depth_lookup import choose_bands, read_covered

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
        If a band has no depth or covers no area of the request, the density is out of range, or the points would fill
        the disc; if a model is damaged, is one of another band, or comes without a magnitude.
    """
    density = arguments.check_number("density", request.density, MIN_DENSITY, MAX_DENSITY, "per arcmin2")
    if layout.current_key(lake, "depth") is None:
        raise BadInput(f"lake {lake} has no table depth: run truesky depth REQUEST {lake} first")
    depth = read.input_version(lake, "depth", request.name)
    bands = _choose_bands(depth, request.band)
    observed_cells, covered = _covered_area(depth, bands, request)
    numbers = random_points.expected_number(covered, density)
    facts = {"seed": request.seed, "density": density, "bands": bands, "depth": depth.key, "code": code_version()}
    files = _model_files(request, bands)
    if files:
        models = {band: _read_model(file).sha256 for band, file in files.items()}
        facts |= {"models": models, "magnitude": _magnitude(request)}
    tasks = cells.tasks_by_row_count(observed_cells.tolist(), numbers, _ROWS_A_FILE, FILE_ORDER)
    plan = Plan(RANDOMS, facts, tasks)
    if not layout.version_folder(lake, RANDOMS.name, plan.key).exists():
        _refuse_full_disc(lake, float(numbers.sum()))
    return [Step(plan, partial(draw_randoms, files))]


def draw_randoms(files: Mapping[str, str], lake: Path, facts: Json) -> Output:
    """Draw the random points of one task, that is in the requested order-8 cells inside one cell.

    Parameters
    ----------
    files : mapping of str to str
        File of the model of detection of each band that has one.
    lake : Path
        Folder of the lake.
    facts : dict
        Parameters of the job and of the task; `generation_cells` are the order-8 cells to fill.

    Returns
    -------
    Output
        Rows of table `randoms`, by position and then in the order of the bands.

    Raises
    ------
    BadInput
        If the file of a model is not the one of the job's start.
    """
    generation_cells = facts["generation_cells"]
    version = read.version(lake, "depth", facts["depth"])
    partitions = _partitions_with(version, generation_cells)
    parts = []
    for band in facts["bands"]:
        depth = read_covered(version, band, random_points.DEPTH_COLUMNS, partitions)
        detection = None
        if band in files:
            model = _read_model(files[band])
            if model.sha256 != facts["models"][band]:
                raise BadInput(
                    f"--model {user_files.format_path(Path(files[band]))}: it was replaced during the job; run it again"
                )
            detection = partial(model.detection_probability, facts["magnitude"])
        columns = random_points.draw_points(generation_cells, facts["density"], facts["seed"], depth, detection)
        parts.append(RANDOMS.build({**columns, "band": np.full(len(columns["id"]), band, object)}))
    rows = pa.concat_tables(parts)
    order = np.argsort(rows["_healpix_29"].to_numpy(), kind="stable")
    return Output(rows.take(pa.array(order)) if len(parts) > 1 else rows)


def _model_files(request: Request, bands: Sequence[str]) -> dict[str, str]:
    """Return the absolute path of the model of each band that has one; raise BadInput for models of other bands."""
    if not request.model and request.magnitude is not None:
        raise BadInput("--magnitude is of use only with --model: give a file of truesky train, too")
    files: dict[str, str] = {}
    for name in request.model:
        where, band = f"--model {user_files.format_path(Path(name))}", _read_model(name).band
        if band not in bands:
            raise BadInput(f"{where}: it is of band {band}, not of {' or '.join(bands)}")
        if band in files:
            raise BadInput(f"{where}: another model is of band {band}, too; give one model for each band")
        # Workers may have another current folder.
        files[band] = str(Path(name).absolute())
    return files


def _magnitude(request: Request) -> float:
    """Return the magnitude of galaxies for the column `detection`; raise BadInput if it is missing or out of range."""
    if request.magnitude is None:
        raise BadInput("--magnitude is missing: --model gives the detection of galaxies of one magnitude")
    return arguments.check_number("magnitude", request.magnitude, MIN_MAGNITUDE, MAX_MAGNITUDE, "mag")


def _read_model(file: str) -> Model:
    """Return the model in a file."""
    return read_model(Path(file))


def _choose_bands(depth: read.Version, bands: Sequence[str]) -> list[str]:
    """Return the requested bands, by default the only one of the table `depth`; raise BadInput if one has no depth."""
    existing = choose_bands(depth)
    if not existing:
        raise BadInput("table depth has no rows: no exposure covers any area")
    choices = ", ".join(existing)
    if not bands and len(existing) > 1:
        raise BadInput(f"--band is missing: table depth has {choices}")
    for band in bands:
        if band not in existing:
            raise BadInput(f"--band {band}: table depth has only {choices}")
    return list(bands) or existing


def _covered_area(depth: read.Version, bands: Sequence[str], request: Request) -> tuple[Int, Float]:
    """Return the order-8 cells of the request that bands cover, and the sums of their covered areas in depth pixels."""
    requested_cells = np.sort(np.array(request.area.cells(), np.int64))
    covered = np.zeros((len(bands), len(requested_cells)))
    for partition in _partitions_with(depth, requested_cells):
        for number, band in enumerate(bands):
            rows = depth.rows(["pixel", "covered"], [partition], pc.field("band") == band)
            cell = sky.parent(rows["pixel"].to_numpy(), ORDER, GENERATION_ORDER)
            at = np.minimum(np.searchsorted(requested_cells, cell), len(requested_cells) - 1)
            inside = requested_cells[at] == cell
            covered[number] += np.bincount(at[inside], rows["covered"].to_numpy()[inside], len(requested_cells))
    for number, band in enumerate(bands):
        if not covered[number].any():
            raise BadInput(f"area: no exposure in band {band} covers it, so there is no area for random points")
    total = covered.sum(axis=0)
    return requested_cells[total > 0.0], total[total > 0.0]


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
    "Draw random points in the areas that bands cover.",
    steps,
    list_options=RANDOM_LISTS,
    number_options=RANDOM_NUMBERS,
)
