"""python -m jobs.request check FILE [--plan]: whether a request is valid, and all of it can be rendered."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from jobs.request.checks import check_rendered
from jobs.request.from_toml import parse
from lake_schema import command


def main(argv: Sequence[str] | None = None) -> int:
    """0 and a line where the request is good, 2 and the key that is not; --plan : it is to be planned alone."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    alone = arguments[2:] == ["--plan"]
    if len(arguments) != 2 + alone or arguments[0] != "check":
        print("usage: python -m jobs.request check FILE [--plan]", file=sys.stderr)
        return 2
    return command.status("request", lambda: _check(Path(arguments[1]), alone))


def _check(path: Path, alone: bool) -> int:
    request = parse(path)
    if not alone:
        check_rendered(request)
    variants = sum(1 for _ in request.variants())
    counts = f"{len(request.pointings)} pointings, {len(request.observations)} observations, {variants} variants"
    print(f"{request.name}: good: {counts}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
