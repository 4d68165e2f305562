"""Check a request (a user's TOML file) as completely as the jobs that run it: truesky check REQUEST [--plan].

With --plan only the checks of the plan of exposures are made, not those of the catalogues.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from lake_schema import command, user_files
from lake_schema.errors import BadInput
from truesky.request import checks
from truesky.request.from_toml import parse
from truesky.request.schema import Request


def main(argv: Sequence[str] | None = None) -> int:
    """Check the request that the arguments (by default sys.argv) name, and return the exit status.

    The status is 0 if the request is valid, which prints a summary. It is 2 for a wrong request, which prints the key
    and the problem, and for wrong arguments.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    plan_only = arguments[1:] == ["--plan"]
    if len(arguments) != 1 + plan_only or arguments[0].startswith("--"):
        print("usage: truesky check REQUEST [--plan]", file=sys.stderr)
        return 2
    return command.run("request", lambda: _check(Path(arguments[0]), plan_only))


def _check(path: Path, plan_only: bool) -> int:
    request = parse(path)
    try:
        check_request(request, plan_only)
    except BadInput as error:
        raise BadInput(f"request {user_files.format_path(path)}: {error}") from None
    variants = sum(1 for _ in request.variants())
    counts = f"{len(request.pointings)} pointings, {len(request.observations)} observations, {variants} variants"
    print(f"{request.name}: good: {counts}")
    if skipped := checks.describe_skipped(request):
        print(f"{request.name}: {skipped}")
    return 0


def check_request(request: Request, plan_only: bool = False) -> None:
    """Check that no job (for catalogues, fluxes, the plan of exposures or images) would refuse a request.

    Parameters
    ----------
    request : Request
        The parsed request, whose single keys are valid.
    plan_only : bool, optional
        Check only the plan of exposures, not the catalogues. Without pointings and observations, the catalogues are
        always checked.

    Raises
    ------
    BadInput
        If a job would refuse the request. The message names the key.
    """
    # Import here, because these modules take seconds to import and a request with a wrong key does not need them.
    from truesky.commands import plan
    from truesky.render.plan_exposures import Planner

    if not request.pointings and not request.observations:
        plan.check_catalogues(request)
    elif plan_only:
        for _ in Planner.from_request(None, request).tables():
            pass
    else:
        for _ in plan.checked_chunks(request):
            pass


if __name__ == "__main__":
    command.exit_with_status(main)
