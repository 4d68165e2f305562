"""Check a request as completely as the jobs do: truesky check REQUEST [--plan].

With --plan only the checks of planning are made.
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
    """Check a request; return 0 and print a summary if it is valid, else return 2 and print the wrong key."""
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
    """Raise BadInput if any job would refuse the request.

    Parameters
    ----------
    request : Request
        The parsed request.
    plan_only : bool, optional
        Check the plan only, not the catalogues.

    Raises
    ------
    BadInput
        If a job would refuse the request. The message names the key.
    """
    # These modules take seconds to import, so import them only after the keys of the request are found valid.
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
