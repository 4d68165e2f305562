"""Code uses every row of the mission database, so changing a row has an effect."""

import ast
import csv
import re
from fnmatch import fnmatchcase
from pathlib import Path

import pytest

from lake_schema.mission.configuration import resolve

ROOT = Path(__file__).parents[3]
# Files that are read directly from the package; their rows record the sources of catalogues.
READ_IN_PLACE = {"env.calibration.planetary_nebula", "env.calibration.vega", "env.dust.map"}


def keys():
    mission = resolve()
    return {record.key for record in (*mission.parameters, *mission.models)}


def named(nodes):
    """Return the strings of a module that are assigned to names."""
    return {
        node.targets[0].id: node.value.value
        for node in nodes
        if isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Name)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    }


def literal(part, names):
    """Return the text of a part of a formatted string, or None if it is computed."""
    if isinstance(part, ast.Constant):
        return part.value
    return names.get(part.value.id) if isinstance(part.value, ast.Name) else None


# A string without spaces, and a formatted one that may give a name.
QUOTED, FORMATTED = re.compile(r'"([^"\s]+)"'), re.compile(r'f"(?=[^"\s]*\{)[^"\s]*[._][^"\s]*"')


def names_in_code(wanted):
    """Return (strings, pattern of formatted strings) of all modules, and of tests that compare images with values.

    A file without any of the wanted names and without a formatted string like a name is not parsed.
    """
    strings, formatted = set(), set()
    paths = {path for room in ("lake_schema", "truesky", "tests") for path in (ROOT / room).rglob("*.py")}
    for path in paths - {Path(__file__)}:
        text = path.read_text()
        if wanted.isdisjoint(QUOTED.findall(text)) and not FORMATTED.search(text):
            continue
        nodes = list(ast.walk(ast.parse(text)))
        names = named(nodes)
        for node in nodes:
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                strings.add(node.value)
            elif isinstance(node, ast.JoinedStr):
                parts = [literal(part, names) for part in node.values]
                # A pattern with hardly any literal text fits every key.
                if sum(len(re.sub(r"\W", "", part)) for part in parts if part) >= 3:
                    formatted.add("".join("[^.]*" if part is None else re.escape(part) for part in parts))
    return strings, re.compile("|".join(f"(?:{pattern})" for pattern in sorted(formatted)))


def test_code_uses_every_row():
    """tests/truesky/render/channels/test_ground_parameters.py checks the rows of ground cameras."""
    own = {key for key in keys() if not key.startswith("ext.")}
    strings, formatted = names_in_code(own | {key.split(".", 1)[1] for key in own})

    def asked(key):
        # Code contains the whole name, or the name within a section.
        return any(name in strings or formatted.fullmatch(name) for name in (key, key.split(".", 1)[1]))

    assert sorted(key for key in own if not asked(key)) == sorted(READ_IN_PLACE)


@pytest.mark.parametrize("table", ["bounds", "counts", "places"])
def test_every_pattern_fits_a_row(table):
    with (ROOT / "lake_schema" / "mission" / f"{table}.csv").open(encoding="utf-8") as stream:
        patterns = {row["pattern"] for row in csv.DictReader(stream)}
    known = keys()
    assert {pattern for pattern in patterns if not any(fnmatchcase(key, pattern) for key in known)} == set()
