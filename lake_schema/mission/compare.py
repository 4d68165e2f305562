"""What tells two mission configurations apart: python -m lake_schema mission diff A B."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from lake_schema import layout, read
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import LADDER, MissionConfiguration, difference, resolve
from lake_schema.mission.parameter import STATUSES
from lake_schema.mission.published import read_back


def compare(first: str, second: str) -> list[str]:
    """A line a name that differs.

    first, second : a ladder ("CBE,BLT,DES,REQ,SIM"), a request file, or a lake, LAKE or LAKE@KEY of its table mission
    """
    return list(difference(configuration(first), configuration(second)))


def configuration(what: str) -> MissionConfiguration:
    """The configuration that a ladder, a request file or a lake stands for."""
    statuses = tuple(what.split(","))
    if all(status in STATUSES for status in statuses):
        return resolve(ladder=statuses)
    if Path(what).is_file():
        return _of_request(Path(what))
    root, _, key = what.partition("@")
    if Path(root).is_dir():
        return read_back(read.version(layout.lake(root), "mission", key or None))
    raise BadInput(f"{what} is neither a ladder of {', '.join(STATUSES)}, nor a request file, nor a lake")


def _of_request(path: Path) -> MissionConfiguration:
    try:
        section: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8")).get("mission", {})
        overrides = {
            key: (float(value["value"]), str(value["unit"])) for key, value in section.get("overrides", {}).items()
        }
        return resolve(ladder=tuple(section.get("ladder", LADDER)), overrides=overrides)
    except (
        OSError,
        UnicodeDecodeError,
        tomllib.TOMLDecodeError,
        AttributeError,
        TypeError,
        KeyError,
        ValueError,
    ) as error:
        raise BadInput(f"request {path}: {' '.join(str(error).split())}") from None
