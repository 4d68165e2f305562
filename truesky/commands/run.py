"""Run all jobs of a request (a user's TOML file) in order, then print a table and draw pictures.

Usage: truesky run REQUEST --lake LAKE [--detectors NAME ...] [--limit N] [--lenses] [--gaia] [--pictures FOLDER]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import pyarrow as pa

from lake_schema import __version__, command, user_files
from lake_schema.store import layout, read
from truesky.catalogue.stars import gaia
from truesky.commands import plan as planning
from truesky.commands import space
from truesky.numerics import cache
from truesky.render.forecasting import catalogue_forecast, speed
from truesky.render.planning import preconditions, tasks
from truesky.request import universe
from truesky.request.from_toml import parse
from truesky.request.schema import Request

# Largest number of pictures of detectors. Each takes about 3 s to draw.
_MAX_PICTURES = 12
_COMPILATION_NOTE = (
    "the renderer has not been compiled on this machine yet: the first detectors take about a minute longer, once"
)
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
_LENSES = Stage("truesky.catalogue.build_strong_lenses", ("strong_lenses",))
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
    job_stages += [_LENSES] * lenses + [fluxes] + [_GAIA] * with_gaia
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
    parser = argparse.ArgumentParser(
        prog="truesky run",
        description="Make everything that a request needs: catalogues, fluxes, plan and images. Then print a table "
        "and draw pictures.",
        epilog=f"Options after -- are passed to spark-submit. truesky {__version__}",
    )
    parser.add_argument("request", type=Path, help="simulation request, a TOML file")
    parser.add_argument("--lake", required=True, help="folder of the lake (created if it does not exist)")
    parser.add_argument("--detectors", nargs="+", default=(), metavar="NAME", help="render only these detectors")
    parser.add_argument("--limit", type=int, metavar="N", help="render at most N detectors")
    parser.add_argument("--lenses", action="store_true", help="also make the table of strong lenses")
    parser.add_argument("--gaia", action="store_true", help="also make the table of stars as Gaia would list them")
    parser.add_argument(
        "--pictures", type=Path, metavar="FOLDER", help="folder for the pictures (default: LAKE/pictures)"
    )
    options = parser.parse_args(argv)

    def run_request() -> int:
        root = layout.resolve_lake(options.lake)
        out = user_files.check_folder(options.pictures or root / "pictures")
        request = replace(parse(options.request), detectors=tuple(options.detectors), limit=options.limit)
        return run(root, options.request, stages(request, options.lenses, options.gaia), request, start, out)

    return command.run("truesky", run_request)


def run(
    root: Path, file: Path, job_stages: Sequence[Stage], request: Request, start: Start, pictures_folder: Path
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
    start : callable
        Function that runs a job: (name of the job's module, command-line arguments) -> exit status.
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
    # Look for the renderer's compiled functions before planning, because planning compiles a part of the renderer.
    is_compiled = any(cache.machine_code_dir().glob("render.drawing.kernels/*.nbi"))
    plan = checked_plan(root, request, job_stages)
    required_gb, free_gb = space.check(root, request, plan)
    count = _print_forecast(root, request, plan, required_gb, free_gb)
    print(f"{_COMPILATION_NOTE}\n" if count and not is_compiled else "", flush=True)
    timings, run_start = [], time.perf_counter()
    for stage in job_stages:
        stage_start = time.perf_counter()
        print(f"{stage.name} ...", flush=True)
        if status := start(stage.module, ["--lake", str(root), "--request", str(file), *stage.options]):
            return status
        timings.append((stage, time.perf_counter() - stage_start))
    _print_table(root, request.name, timings, time.perf_counter() - run_start)
    if plan is not None:
        _print_results(root, pictures_folder, request.name)
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


def _print_forecast(
    root: Path, request: Request, plan: tuple[pa.Table, pa.Table] | None, required_gb: float, free_gb: float
) -> int:
    """Print the forecast of time and size of the whole run, and return the number of detectors to render.

    `required_gb` and `free_gb` are the size of the files to write and the free space, in GB. The printed time includes
    tables and images that the lake already contains, although they will not be made again.
    """
    machine = speed.estimate_speed(root)
    seconds = sum(line.seconds for line in catalogue_forecast.for_request(request, machine.factor))
    count = 0
    if plan is not None:
        requested_tasks = tasks.select_requested(preconditions.require_renderable_tasks(*plan), request)
        count, seconds = (
            len(requested_tasks),
            seconds + machine.factor * sum(task["seconds"] for task in requested_tasks),
        )
    hours, cores = seconds / 3600.0, catalogue_forecast.WORKERS
    print(
        f"forecast: {count:,} detectors, {hours:.2f} core-hours of this machine ({machine.source}), "
        f"{hours / cores:.2f} h on {cores} cores; {required_gb:.2f} GB to write, {free_gb:.2f} GB are free"
    )
    return count


def _print_table(root: Path, request: str, stages: Sequence[tuple[Stage, float]], total: float) -> None:
    print(f"\n{'stage':20} {'table':14} {'rows':>10} {'rows/s':>10} {'MB':>8} {'seconds':>8}")
    for stage, seconds in stages:
        versions = [read.version(root, name, request=request) for name in stage.tables]
        rows = sum(version.num_rows for version in versions)
        for i, version in enumerate(versions):
            size = sum(entry["bytes"] for entry in version.manifest["files"]) / 1e6
            pace = f"{rows / seconds:10,.1f} {size:8.1f} {seconds:8.1f}" if i == 0 else f"{'':10} {size:8.1f}"
            print(f"{stage.name if i == 0 else '':20} {version.table:14} {version.num_rows:10,} {pace}")
    print(f"{'all':20} {'':14} {'':10} {'':10} {'':8} {total:8.1f}\n")


def _print_results(root: Path, pictures_folder: Path, request: str) -> None:
    # Import here, because importing the renderer takes seconds and runs without images do not need it.
    from truesky.render.forecasting import actual_costs
    from truesky.render.products import preview, same_sky

    for line in actual_costs.format_table(actual_costs.summarise(root, request, speed.estimate_speed(root).factor)):
        print(line)
    print()
    for picture in (
        *preview.previews(root, pictures_folder, _MAX_PICTURES, request),
        *same_sky.draw(root, pictures_folder, request),
    ):
        print(picture)
