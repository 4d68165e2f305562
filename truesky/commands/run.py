"""Run all jobs of a request (a user's TOML file) in order, then print a table and draw pictures.

Usage: truesky run REQUEST LAKE [--dry-run] [--detectors NAME ...] [--limit N] [--lenses] [--gaia] [--pictures FOLDER]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import pyarrow as pa

from lake_schema import user_files
from lake_schema.store import layout
from lake_schema.texts.amounts import format_size
from truesky.catalogue.stars import gaia
from truesky.command_line import commands
from truesky.commands import closing_table, costs, space
from truesky.commands import plan as planning
from truesky.render.forecasting import catalogue_forecast, request_cost
from truesky.request import universe
from truesky.request.from_toml import parse
from truesky.request.schema import Request
from truesky.running import compile_ahead, progress

# Type of a function that runs a job: (name of the job's module, command-line arguments) -> exit status.
Start = Callable[[str, Sequence[str]], int]


@dataclass(frozen=True, slots=True)
class Stage:
    """One job of a run, such as the making of the star catalogue.

    Attributes
    ----------
    module : str
        Name of the module that defines the job as `JOB`.
    tables : tuple of str
        Names of the tables of this job that are listed at the end of the run.
    changes : tuple of (str, tuple of str or int)
        Pairs (field of the request, value) for fields that have another value in this job than in the user's file.
    """

    module: str
    tables: tuple[str, ...]
    changes: tuple[tuple[str, tuple[str, ...] | int], ...] = ()

    @property
    def name(self) -> str:
        """Return the name of the job, the last part of the name of its module."""
        return self.module.rpartition(".")[2]

    @property
    def options(self) -> tuple[str, ...]:
        """Return the changed fields of the request as options of the job's command line, such as "--limit", "3"."""
        words = ((f"--{name}", *(value if isinstance(value, tuple) else (str(value),))) for name, value in self.changes)
        return tuple(chain.from_iterable(words))

    def request(self, request: Request) -> Request:
        """Return a copy of the request in which this job's `changes` replace the values of the request."""
        return replace(request, **dict(self.changes))  # type: ignore[arg-type]


CATALOGUES = (
    Stage("truesky.catalogue.build_galaxies", ("galaxies",)),
    Stage("truesky.catalogue.build_stars", ("stars",)),
    Stage("truesky.fluxes.compute_fluxes", ("galaxy_fluxes", "star_fluxes")),
)
_TRANSIENTS = Stage("truesky.catalogue.build_transients", ("transients",))
_LENSES = Stage("truesky.catalogue.build_strong_lenses", ("strong_lenses",))
_LENSED_IMAGES = Stage("truesky.catalogue.build_lensed_images", ("lensed_images",))
_NUCLEI = Stage("truesky.catalogue.build_active_nuclei", ("active_nuclei",))
_GAIA = Stage("truesky.catalogue.build_gaia", ("gaia",))
IMAGES = (
    Stage("truesky.render.plan_exposures", ("exposures", "tasks")),
    Stage("truesky.render.render_exposures", ("products",)),
)


def stages(request: Request, lenses: bool = False, with_gaia: bool = False) -> list[Stage]:
    """Return the jobs of a request in the order in which they run.

    Parameters
    ----------
    request : Request
        The request. Without pointings and observations, the jobs that plan and render exposures are left out.
    lenses : bool, optional
        Add the job that makes the table of strong lenses.
    with_gaia : bool, optional
        Add the job that makes a table of the stars as Gaia would list them. Fluxes are then also computed in the bands
        of Gaia.

    Returns
    -------
    list of Stage
        The jobs.
    """
    *job_stages, fluxes = CATALOGUES
    if with_gaia:
        fluxes = replace(fluxes, changes=(("bands", tuple(dict.fromkeys((*request.bands, *gaia.BANDS)))),))
    has_variables = request.universe.variables and request.sources is None
    job_stages += [_NUCLEI] * has_variables + [_TRANSIENTS] * (request.transients is not None)
    job_stages += [_LENSES] * lenses + [_LENSED_IMAGES] * (lenses and (request.transients is not None or has_variables))
    job_stages += [fluxes] + [_GAIA] * with_gaia
    if not request.pointings and not request.observations:
        return job_stages
    plan, render = IMAGES
    changes: tuple[tuple[str, tuple[str, ...] | int], ...] = ()
    if request.detectors:
        changes += (("detectors", request.detectors),)
    if request.limit is not None:
        changes += (("limit", request.limit),)
    tables = (*render.tables, "exposure_files") if request.files == "exposure" else render.tables
    return [*job_stages, plan, replace(render, tables=tables, changes=changes)]


def main(argv: Sequence[str], start: Start) -> int:
    """Run the command `truesky run`.

    Parameters
    ----------
    argv : sequence of str
        Arguments of the command, without its name.
    start : callable
        Function that runs a job: (name of the job's module, command-line arguments) -> exit status.

    Returns
    -------
    int
        0, the exit status of the first job that fails, or 2 if the request is invalid or the disc has too little free
        space. Wrong options end the process with status 2.
    """
    return commands.run("run", lambda options: run_command(options, start), argv)


def run_command(options: argparse.Namespace, start: Start) -> int:
    """Run `truesky run` with its parsed arguments.

    Parameters
    ----------
    options : argparse.Namespace
        The parsed arguments.
    start : callable
        Function that runs a job: (name of the job's module, command-line arguments) -> exit status.

    Returns
    -------
    int
        0, or the exit status of the first job that fails.

    Raises
    ------
    BadInput
        If the request is invalid or the disc has too little free space.
    """
    root, file = layout.resolve_lake(options.lake), Path(options.request)
    out = user_files.check_folder(options.pictures or root / "pictures")
    request = replace(parse(file), detectors=tuple(options.detectors), limit=options.limit)
    job_stages = stages(request, options.lenses, options.gaia)
    if options.dry_run:
        return run(root, file, job_stages, request, None, out)
    functions = compile_ahead.missing_functions(compile_ahead.groups_of_request(request))
    if functions:
        print(f"functions to compile in the background, once on this machine: {len(functions)}", flush=True)
    with compile_ahead.compile_in_background(functions):
        return run(root, file, job_stages, request, start, out)


def run(
    root: Path, file: Path, job_stages: Sequence[Stage], request: Request, start: Start | None, pictures_folder: Path
) -> int:
    """Check a request and the free space, run its jobs, then print a table and draw pictures of some images.

    Parameters
    ----------
    root : Path
        Folder of the lake, in which the tables are made.
    file : Path
        File of the request.
    job_stages : sequence of Stage
        Jobs of the request in order, from `stages`.
    request : Request
        The parsed request, with the detectors to render from the command line.
    start : callable or None
        Function that runs a job: (name of the job's module, command-line arguments) -> exit status. With None, the
        forecast is printed and no job runs.
    pictures_folder : Path
        Folder for the pictures.

    Returns
    -------
    int
        Exit status of the first job that fails (later jobs do not run), else 0.

    Raises
    ------
    BadInput
        If a job would refuse the request or the free space is too small. No job has run then.
    """
    # Find mistakes in the request and a lack of free space before the first job runs.
    universe.check_lake(root, request)
    plan = checked_plan(root, request, job_stages)
    required_gb, free_gb = space.check(root, request, plan)
    cost = costs.forecast_plan(root, request, plan)
    for line in request_cost.format_table(cost):
        print(line)
    print(f"{format_size(1e9 * required_gb)} to write, {format_size(1e9 * free_gb)} are free\n", flush=True)
    if start is None:
        return 0
    timings: list[tuple[Stage, float]] = []
    run_start = time.perf_counter()
    progress.announce_run(_forecast_times(cost, job_stages), catalogue_forecast.WORKERS)
    for stage in job_stages:
        progress.announce_job([seconds for _, seconds in timings])
        stage_start = time.perf_counter()
        print(f"{stage.name} ...", flush=True)
        if status := start(stage.module, ["--lake", str(root), "--request", str(file), *stage.options]):
            return status
        timings.append((stage, time.perf_counter() - stage_start))
    progress.announce_job([seconds for _, seconds in timings])
    closing_table.print_catalogues(root, request, timings, time.perf_counter() - run_start)
    if plan is not None:
        closing_table.print_images(root, pictures_folder, request.name)
    return 0


def checked_plan(root: Path, request: Request, stages: Sequence[Stage]) -> tuple[pa.Table, pa.Table] | None:
    """Check that no job would refuse a request, and plan its exposures.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    request : Request
        The request, with the detectors to render from the command line.
    stages : sequence of Stage
        Jobs of the request, at least one.

    Returns
    -------
    tuple of pyarrow.Table or None
        Rows of the tables `exposures` (planned exposures) and `tasks` (their detectors) if the last job renders images,
        else None.

    Raises
    ------
    BadInput
        If a job would refuse the request.
    """
    if stages[-1].name == IMAGES[-1].name:
        return planning.check(request, root)
    planning.check_catalogues(request)
    return None


def _forecast_times(cost: request_cost.RequestCost, job_stages: Sequence[Stage]) -> list[tuple[str, float]]:
    """Return the name and the forecast wall time (s) of each job, for the display of the progress.

    The time of products that are computed once is part of the time of the first job.
    """
    wall_times = {job.job: job.wall_s for job in cost.jobs}
    times = [(stage.name, wall_times.get(stage.name, 0.0)) for stage in job_stages]
    (first, seconds), *later_jobs = times
    return [(first, seconds + sum(item.wall_s for item in cost.items)), *later_jobs]
