"""Plan the exposures of a request (a user's TOML file), or check the request and forecast its cost with --dry-run.

This is the job of `truesky.render.plan_exposures` with the additional option --dry-run. It checks the whole request and
forecasts the cost of its images and of its catalogues.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

from truesky.catalogue import request_checks
from truesky.fluxes import inputs
from truesky.render import plan_exposures
from truesky.render.forecasting import catalogue_forecast, speed
from truesky.render.plan_exposures import Planner, PlanRows
from truesky.render.planning import preconditions, tasks
from truesky.render.products.keys import ephemeris_files, stamp_files
from truesky.request.checks import check_rendered
from truesky.request.schema import Request
from truesky.running.submitted_job import Step


def check(request: Request, lake: Path | None = None) -> PlanRows:
    """Plan the exposures of a request, and check that no job would refuse the request.

    Parameters
    ----------
    request : Request
        The request.
    lake : Path, optional
        Folder of the lake whose catalogues give the density of sources for the forecast of costs. Without it, models
        of number counts in the mission database are used.

    Returns
    -------
    tuple of pyarrow.Table
        Rows of the tables `exposures` (planned exposures) and `tasks` (their detectors, with forecast costs).

    Raises
    ------
    BadInput
        If a job would refuse the request. The message names the key, or the file and its line.
    """
    return plan_exposures.concatenate(checked_chunks(request, lake))


def checked_chunks(request: Request, lake: Path | None = None) -> Iterator[PlanRows]:
    """Plan and check a request as `check` does, but yield the plan in chunks of exposures to save memory.

    Parameters
    ----------
    request : Request
        The request.
    lake : Path, optional
        Folder of the lake whose catalogues give the density of sources, as in `check`.

    Yields
    ------
    tuple of pyarrow.Table
        Rows of the tables `exposures` and `tasks` of a chunk. Not all checks are made before the last chunk.

    Raises
    ------
    BadInput
        If a job would refuse the request.
    """
    check_rendered(request)
    # Plan the first chunk before the catalogues are checked, so that a mistake in a pointing or an observation is
    # reported before a mistake in the catalogues.
    chunks = Planner.from_request(lake, request).tables()
    first_chunk = next(chunks)
    check_catalogues(request)
    if request.structure.stamps is not None:
        stamp_files(request.structure.stamps.file)
    selection, has_tasks = tasks.TaskSelection(request), False
    for exposures, rows in chain([first_chunk], chunks):
        if request.bodies is not None:
            ephemeris_files(request.bodies, exposures)
        drawable_tasks = preconditions.renderable_tasks(exposures, rows)
        has_tasks = has_tasks or drawable_tasks.num_rows > 0
        preconditions.refuse_small_area(request.area, selection.select(drawable_tasks))
        yield exposures, rows
    if not has_tasks:
        preconditions.require_renderable_tasks(exposures, rows)
    selection.refuse_unknown()


def check_catalogues(request: Request) -> None:
    """Raise BadInput if the jobs that make catalogues and fluxes would refuse the request."""
    inputs.select_passbands(request.bands, inputs.read(request.curves).passbands)
    request_checks.check_request(request)


def dry_run(lake: Path, request: Request) -> Sequence[Step]:
    """Check a request, and print the forecast costs of its images and of its catalogues.

    Return (), since no table is made. Raises BadInput if a job would refuse the request.
    """
    plan_exposures.print_forecast(lake, request, checked_chunks(request, lake))
    print()
    for line in catalogue_forecast.format_table(
        catalogue_forecast.for_request(request, speed.estimate_speed(lake).factor)
    ):
        print(line)
    return ()


JOB = replace(plan_exposures.JOB, dry_run=dry_run)
