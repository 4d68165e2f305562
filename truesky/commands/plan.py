"""Plan the exposures of a request (a user's TOML file), or check the request and forecast its cost with --dry-run.

This is the job of `truesky.render.plan_exposures` with the additional option --dry-run. It checks the whole request and
forecasts the cost of its images and of its catalogues.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from lake_schema.errors import Mistakes
from truesky.catalogue import request_checks
from truesky.fluxes import inputs
from truesky.render import plan_exposures
from truesky.render.forecasting import forecast, request_cost
from truesky.render.forecasting.image_costs import ImageCosts
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
    with Mistakes() as mistakes:
        mistakes.read(check_rendered, request)
        # Exposures without a simulator are not planned here: their plan could have follow-up errors.
        planner = None if len(mistakes) else mistakes.read(Planner.from_request, lake, request)
        mistakes.read(check_catalogues, request)
        if request.structure.stamps is not None:
            mistakes.read(stamp_files, request.structure.stamps.file)
        if len(mistakes) and planner is not None:
            # Report the mistakes in the plan together with the others.
            mistakes.read(_check_plan, planner)
    if planner is not None:
        yield from _planned_chunks(planner)


def check_plan(request: Request) -> None:
    """Raise BadInput if the exposures of a request cannot be planned, without a check of its catalogues."""
    for _ in Planner.from_request(None, request).tables():
        pass


def _check_plan(planner: Planner) -> None:
    for _ in _planned_chunks(planner):
        pass


def _planned_chunks(planner: Planner) -> Iterator[PlanRows]:
    """Yield the tables `exposures` and `tasks` of each chunk of a plan, and check them.

    Raises BadInput if a file of the request does not cover the dates of the exposures, or if no detector can be
    rendered, or if the area is too small. The mistakes of all chunks are raised together after the last chunk.
    """
    request = planner.request
    selection, has_tasks = tasks.TaskSelection(request), False
    with Mistakes() as mistakes:
        for exposures, rows in planner.tables():
            if request.bodies is not None:
                mistakes.read(ephemeris_files, request.bodies, exposures)
            drawable_tasks = preconditions.renderable_tasks(exposures, rows)
            has_tasks = has_tasks or drawable_tasks.num_rows > 0
            mistakes.read(preconditions.refuse_small_area, request.area, selection.select(drawable_tasks))
            yield exposures, rows
        if not has_tasks:
            mistakes.read(preconditions.require_renderable_tasks, exposures, rows)
        mistakes.read(selection.refuse_unknown)


def check_catalogues(request: Request) -> None:
    """Raise BadInput if the jobs that make catalogues and fluxes would refuse the request.

    There is one line for each mistake.
    """
    with Mistakes() as mistakes:
        user_passbands = mistakes.read(inputs.check_files, request.curves)
        if user_passbands is not None:
            mistakes.read(inputs.select_passbands, request.bands, user_passbands)
        mistakes.read(request_checks.check_request, request)


def dry_run(lake: Path, request: Request, as_json: bool = False) -> Sequence[Step]:
    """Check a request, and print the forecast costs of its images and of a whole run.

    Parameters
    ----------
    lake : Path
        Folder of the lake, which need not exist.
    request : Request
        The request.
    as_json : bool, optional
        True to print JSON instead of tables.

    Returns
    -------
    sequence of Step
        (), since no table is made.

    Raises
    ------
    BadInput
        If a job would refuse the request.
    """
    images = ImageCosts(request)
    lines, machine = plan_exposures.forecast_images(lake, request, images.watch(checked_chunks(request, lake)))
    cost = request_cost.forecast(request, images, machine)
    if as_json:
        print(json.dumps({"images": [asdict(line) for line in lines], "cost": cost.as_json()}, indent=2))
    else:
        print(*forecast.format_table(lines, machine), "", *request_cost.format_table(cost), sep="\n")
    return ()


JOB = replace(plan_exposures.JOB, dry_run=dry_run)
