"""Check a request (a user's TOML file) as completely as the jobs that run it: truesky check REQUEST [--plan] [--json].

The output has the sky of each band with its causes, and ends with the forecast cost of the request. With --plan only
the checks of the plan of exposures are made, not those of the catalogues, and neither sky nor cost is printed.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from lake_schema import command, user_files
from lake_schema.errors import BadInput, Mistakes
from truesky.command_line import commands
from truesky.request import checks, request_lines, sky_notation
from truesky.request.from_toml import ValidParts, read_file, read_valid_parts
from truesky.request.schema import Request

if TYPE_CHECKING:
    from truesky.render.forecasting.request_cost import RequestCost

# Keys of a request on which the catalogues depend. If one of them has a mistake, the catalogues are not checked.
_CATALOGUE_KEYS = {"universe", "stars", "ingest", "sources", "fluxes", "seed"}


def main(argv: Sequence[str] | None = None) -> int:
    """Check the request that the arguments (by default sys.argv) name, and return the exit status.

    The status is 0 if the request is valid, which prints a summary. It is 2 for a wrong request, which prints one line
    for each mistake, with the key and the problem. Wrong arguments end the process with status 2.
    """
    return commands.run("check", run_command, argv)


def run_command(options: argparse.Namespace) -> int:
    """Check the request in the parsed arguments of `truesky check`, print a summary, and return 0.

    BadInput is raised for a wrong request.
    """
    path = Path(options.request)
    # `Path.is_dir` raises an error if the name is too long.
    if os.path.isdir(path):
        text = user_files.format_path(path)
        raise BadInput(f"request {text}: is a folder, but must be a TOML file; truesky verify {text} checks a lake")
    table = read_file(path)
    try:
        request, cost = checked_request(read_valid_parts(table, path.resolve().parent), options.plan)
    except BadInput as error:
        raise request_lines.with_request_file(error, path) from None
    understood = [*sky_notation.understood_values(table), *checks.unused_values(table)]
    counts = {
        "pointings": len(request.pointings),
        "observations": len(request.observations),
        "variants": sum(1 for _ in request.variants()),
    }
    skipped = checks.describe_skipped(request)
    if options.json:
        summary = {"request": request.name, **counts, "bands": request.bands, "understood": understood}
        print(json.dumps({**summary, "skipped": skipped, "cost": None if cost is None else cost.as_json()}, indent=2))
        return 0
    print(f"{request.name}: good: {', '.join(f'{count} {name}' for name, count in counts.items())}")
    if not request.pointings and not request.observations:
        understood.append(f"no exposures; fluxes in {', '.join(request.bands)}")
    for line in (*understood, *([skipped] if skipped else []), *(() if cost is None else cost.sky)):
        print(f"{request.name}: {line}")
    if cost is not None:
        from truesky.render.forecasting import request_cost

        print(*request_cost.format_table(cost), sep="\n")
    return 0


def checked_request(parts: ValidParts, plan_only: bool = False) -> tuple[Request, RequestCost | None]:
    """Check a request as completely as the jobs, and forecast its cost.

    Parameters
    ----------
    parts : ValidParts
        The request, and the mistakes that were found when it was read. Its valid parts are checked even then.
    plan_only : bool, optional
        Check only the plan of exposures, as in `check_request`.

    Returns
    -------
    request : Request
        The request.
    cost : RequestCost or None
        Forecast of the cost, as from `check_request`.

    Raises
    ------
    BadInput
        If the request has mistakes. There is one line for each.
    """
    with Mistakes() as mistakes:
        request, cost = mistakes.read(parts.valid_request), None
        if request is not None:
            cost = mistakes.read(check_request, request, plan_only)
        elif parts.request is not None:
            mistakes.read(_check_valid_parts, parts.request, parts.invalid, plan_only)
    return request, cost


def _check_valid_parts(request: Request, invalid: frozenset[str], plan_only: bool) -> None:
    """Check the parts of a request that do not depend on the keys in `invalid`, which have mistakes."""
    has_exposures = bool(request.pointings or request.observations)
    has_catalogues = not plan_only and not invalid & _CATALOGUE_KEYS
    if invalid & {"pointing", "observation"}:
        # A PSF may belong to an exposure that has a mistake.
        request = replace(request, psfs=())
    if has_exposures or has_catalogues:
        check_request(request, plan_only or not has_catalogues)


def check_request(request: Request, plan_only: bool = False) -> RequestCost | None:
    """Check that no job (for catalogues, fluxes, the plan of exposures or images) would refuse a request.

    Parameters
    ----------
    request : Request
        The parsed request, whose single keys are valid.
    plan_only : bool, optional
        Check only the plan of exposures, not the catalogues. Without pointings and observations, the catalogues are
        always checked.

    Returns
    -------
    RequestCost or None
        Forecast of the cost to run the request on this machine; None if only the plan was checked.

    Raises
    ------
    BadInput
        If a job would refuse the request. There is one line for each mistake, which names the key.
    """
    # Import here, because these modules take seconds to import and a request with a wrong key does not need them.
    from truesky.commands import costs, plan

    if plan_only and (request.pointings or request.observations):
        plan.check_plan(request)
        return None
    return costs.check_and_forecast(request)


if __name__ == "__main__":
    command.exit_with_status(main)
