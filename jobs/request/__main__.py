"""python -m jobs.request check FILE: whether a request is valid."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from jobs.request.from_toml import parse
from lake_schema import command


def main(argv: Sequence[str] | None = None) -> int:
    """python -m jobs.request check FILE: 0 and a line where the request is good, 2 and the key that is not."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if len(arguments) != 2 or arguments[0] != "check":
        print("usage: python -m jobs.request check FILE", file=sys.stderr)
        return 2
    return command.status("request", lambda: _check(Path(arguments[1])))


def _check(path: Path) -> int:
    request = parse(path)
    variants = sum(1 for _ in request.variants())
    counts = f"{len(request.pointings)} pointings, {len(request.observations)} observations, {variants} variants"
    print(f"{request.name}: good: {counts}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
