"""Print docs/limits.md, the tables of all numbers that users and the tables of truesky give, with their limits.

    python -m scripts.limits_tables > docs/limits.md

The code gives the limits: the calls that read a request or check an argument, and the declarations of tables and
parameters.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path

from lake_schema import tables
from lake_schema.mission import bounds, camera_tables
from lake_schema.mission.parameter import read_all_parameters
from scripts import request_keys
from truesky.catalogue import dust_map, given_sources
from truesky.catalogue.external import mapping
from truesky.catalogue.stars import bright_stars, from_catalogue
from truesky.cosmology import MIN_M_NU
from truesky.render.sources import ephemerides
from truesky.request.exposures import pointing_tables, visit_tables

_ROOT = Path(__file__).resolve().parents[1]
_HEAD = f"""# Limits of all numbers

Written by `python -m scripts.limits_tables > docs/limits.md`; do not edit.

A number must lie between its limits, which are included. An empty field means that there is no limit. NaN and
infinity are refused, and so is a text in quotes instead of a number. A value outside is refused in one line that names
its place. Further conditions can relate numbers to each other; for example, an area must be convex. The sum of the
masses of neutrinos `m_nu` must be 0, or at least {MIN_M_NU:g} eV. Properties of galaxies in files of users that are
stored in single precision may exceed a limit by 1e-6 of it, and are then set to the limit.
"""
_MISSION = """Numbers of `[mission.overrides]`, `[explore]`, a camera's `parameters.csv` and `bands.csv`, and of the
database itself. A parameter must lie within the limits of every pattern that matches its name. `*` stands for any
text, and `?` for one character. The last column is the number of parameters of the database that match.
"""
_ARGUMENTS = """Arguments of Python functions by module, with limits that are constants. Options of commands that set
these arguments have the same limits.
"""
# Columns of numbers in the files of users: kind of file, key of the request or command, and limits by column.
_FILES: tuple[tuple[str, str, Mapping[str, tuple[float, float]]], ...] = (
    ("Table of pointings", "[[observation]] pointings", pointing_tables.BOUNDS),
    (
        "Table of visits",
        "[[observation]] pointings",
        {**visit_tables.BOUNDS, **visit_tables.ANGLES, **visit_tables.OPTIONAL},
    ),
    ("Tables of a camera", "[mission] cameras", {**camera_tables.INTEGER_BOUNDS, **camera_tables.NUMBER_BOUNDS}),
    ("Galaxies", "[ingest.galaxies]", mapping.GALAXY_BOUNDS),
    ("Haloes", "[ingest.halos]", mapping.HALO_BOUNDS),
    ("Training galaxies", "[ingest.training]", mapping.TRAINING_BOUNDS),
    ("Stars", "[stars] catalogue", from_catalogue.KEYS),
    ("Galaxies without a universe, or added to images", "[sources] galaxies", given_sources.GIVEN_GALAXY_BOUNDS),
    ("Stars without a universe, or added to images", "[sources] stars", given_sources.GIVEN_STAR_BOUNDS),
    ("Tycho-2", "[stars] tycho2", dict.fromkeys(("BTmag", "VTmag"), bright_stars.MAGNITUDES)),
    ("Map of dust, A(V)", "[ingest.dust]", {"column": (0.0, dust_map.MAX_A_V)}),
    ("Bodies of the solar system", "[solar_system] bodies", ephemerides.KEYS),
)


def text() -> str:
    """Return the text of docs/limits.md."""
    sections = {
        "Request": _request(),
        "Tables of a lake": _lake(),
        "Mission database": [*_MISSION.splitlines(), "", *_mission()],
        "Files of users": _files(),
        "Command line and Python": [*_ARGUMENTS.splitlines(), "", *_arguments()],
    }
    lines = _HEAD.splitlines()
    for title, section in sections.items():
        lines += ["", f"## {title}", "", *section]
    return "\n".join(lines) + "\n"


def _format_number(value: float | None) -> str:
    if value is None:
        return ""
    return str(value) if isinstance(value, int) else f"{value:.10g}"


def _table(titles: Sequence[str], rows: Iterator[Sequence[str]]) -> list[str]:
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    return lines + [f"| {' | '.join(row)} |" for row in rows]


def _request() -> list[str]:
    def rows() -> Iterator[Sequence[str]]:
        for name, key in sorted(request_keys.all_keys().items()):
            if not key.is_number or key.lo == -math.inf:
                continue
            limits = (_format_number(key.lo), _format_number(key.hi))
            if key.legal:
                limits = (f"one of {', '.join(map(str, key.legal))}", "")
            yield f"`{name}`", key.kind, *limits, key.unit

    return _table(("key", "is a", "from", "to", "unit"), rows())


def _lake() -> list[str]:
    def rows() -> Iterator[Sequence[str]]:
        for table in tables.all_tables(["<band>"], variables=True):
            for column in table.columns:
                if column.type not in ("string", "bool") and not column.codes:
                    limits = (_format_number(column.lo), _format_number(column.hi))
                    yield f"`{table.name}.{column.name}`", column.type, *limits, column.unit

    return _table(("column", "type", "from", "to", "unit"), rows())


def _mission() -> list[str]:
    keys = sorted({parameter.key for parameter in read_all_parameters()})

    def rows() -> Iterator[Sequence[str]]:
        for pattern, lo, hi, unit in bounds.read_bounds():
            matching = [key for key in keys if bounds.matches(key, pattern)]
            kind = "whole number" if matching and all(map(bounds.is_count, matching)) else "number"
            yield f"`{pattern}`", kind, _format_number(lo), _format_number(hi), unit, str(len(matching))

    return _table(("parameters", "is a", "from", "to", "unit", "number"), rows())


def _files() -> list[str]:
    lines = []
    for title, key, limits in _FILES:
        lines += [f"### {title}: `{key}`", ""]
        rows = ((f"`{name}`", _format_number(lo), _format_number(hi)) for name, (lo, hi) in limits.items())
        lines += [*_table(("column", "from", "to"), rows), ""]
    return lines[:-1]


def _arguments() -> list[str]:
    """Return the table of the arguments that functions check with constant limits, found in the source files."""

    def rows() -> Iterator[Sequence[str]]:
        for path in sorted([*(_ROOT / "truesky").rglob("*.py"), *(_ROOT / "lake_schema").rglob("*.py")]):
            source = path.read_text(encoding="utf-8")
            if "arguments.check_" not in source:
                continue
            module = ".".join(path.relative_to(_ROOT).with_suffix("").parts)
            for call in ast.walk(ast.parse(source)):
                if isinstance(call, ast.Call) and ast.unparse(call.func).startswith("arguments.check_"):
                    yield from _argument_row(module, call)

    return _table(("argument", "of", "from", "to", "unit"), iter(dict.fromkeys(rows())))


def _argument_row(module: str, call: ast.Call) -> Iterator[Sequence[str]]:
    """Yield the row of a call that checks an argument, if its name and its limits are constants of the module."""
    name, *limits = (ast.unparse(argument) for argument in (call.args[0], *call.args[2:]))
    if not isinstance(call.args[0], ast.Constant) or not limits:
        return
    try:
        # The text is code of this repository.
        lo, hi, *unit = eval(f"[{', '.join(limits)}]", vars(import_module(module)))  # noqa: S307
    except NameError:
        # The limits are variables of the function.
        return
    unit = unit or ["deg"] * ast.unparse(call.func).endswith("degrees") or [""]
    yield f"`{name[1:-1]}`", f"`{module}`", _format_number(lo), _format_number(hi), unit[0]


if __name__ == "__main__":
    print(text(), end="")
