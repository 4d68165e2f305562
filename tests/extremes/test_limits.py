"""Every number of a request, of the mission database and of tables is refused beyond its limits, in one line."""

import copy
import math
import os
import re
import tempfile
from collections import Counter
from dataclasses import fields, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from lake_schema import tables
from lake_schema.columns import round_mantissa
from lake_schema.errors import BadInput, quote_value
from lake_schema.mission import bounds
from lake_schema.mission.configuration import resolve
from lake_schema.mission.parameter import convert
from lake_schema.store.validate import find_violations
from scripts import limits_tables, request_keys
from truesky.catalogue import given_sources, injected_rows
from truesky.render.camera import detectors
from truesky.render.effects.light import straylight
from truesky.render.effects.readout import nonlinearity, trap_pumping
from truesky.render.effects.scene import Scene
from truesky.request import checks, from_toml, instruments
from truesky.request.accuracy import Accuracy
from truesky.request.exposures import pointing_tables
from truesky.request.exposures.observations import Observation
from truesky.request.exposures.pointings import Pointing
from truesky.request.files import UserSources
from truesky.request.schema import Request, Stars, Universe
from truesky.request.structure import Arms, Stamps

PAGE = Path(__file__).resolve().parents[2] / "docs" / "limits.md"
# Numbers of examples of the default test and of the nightly one.
FEW, MANY = 30, 20_000
MISSION = resolve()
COLUMNS = [(t, c) for t in tables.all_tables(["euclid_vis"]) for c in t.columns if c.type[:3] in ("int", "flo")]
HUGE = (2**63, -(2**63) - 1, 2**64, 10**400, -(10**400), 16**5000)


def test_the_page_is_up_to_date():
    """If this fails, run: python -m scripts.limits_tables > docs/limits.md"""
    assert PAGE.read_text(encoding="utf-8") == limits_tables.text()


def test_limits_of_the_promises_are_those_of_the_page():
    text = PAGE.with_name("promises.md").read_text(encoding="utf-8").partition("## Numbers and their limits")[2]
    rows = [line for line in text.partition("\n## ")[0].splitlines() if line.startswith("| `")]
    assert len(rows) > 5
    assert {*rows} <= {*PAGE.read_text(encoding="utf-8").splitlines()}


# ------------------------------------------------------------------------------------------------ values


@st.composite
def values(draw, lo, hi, is_whole):
    """Draw a number at a limit, just inside or outside, up to three decades outside, or one that is not finite."""
    lo, hi = (-math.inf if lo is None else lo), (math.inf if hi is None else hi)
    limit, sign = draw(st.sampled_from([(lo, -1), (hi, 1)]))
    if not math.isfinite(limit):
        limit = sign * 1e3
    # A decade beyond 0 is counted from the other limit.
    scale = max(abs(limit), abs(hi - lo) if math.isfinite(hi - lo) else 0.0, 1e-6)
    far = limit + sign * scale * 10.0 ** draw(st.floats(-9.0, 3.0))
    if is_whole:
        near = [limit, limit - sign, limit + sign, round(far), limit + 0.5, float(limit)]
        return draw(st.sampled_from([*near, *HUGE, math.nan, math.inf]))
    near = [limit, math.nextafter(limit, 0.0), math.nextafter(limit, sign * math.inf), far, lo + 0.5 * (hi - lo)]
    strange = [math.nan, math.inf, -math.inf, -0.0, 5e-324, -5e-324, *HUGE]
    return draw(st.sampled_from([*near, *near, *strange]))


def is_inside(value, lo, hi):
    return (lo is None or value >= lo) and (hi is None or value <= hi) and abs(value) < math.inf


def judge(read, value, name, inside):
    """Return "accepted" or "refused" for a reader of a value; it must refuse what is outside in lines with the name."""
    messages = ()
    try:
        read()
    except BadInput as error:
        messages = error.messages
    assert all(len(line.splitlines()) == 1 and len(line) <= 1000 for line in messages)
    if not inside:
        assert any(name in line for line in messages), f"{name} = {quote_value(value)}: {messages or 'accepted'}"
    # A number inside its limits may be refused only because of another number.
    assert not inside or not any(re.search(rf"{re.escape(name)}.* outside \[", line) for line in messages)
    return "refused" if messages else "accepted"


def examples(numbers, strategy_of, check):
    """Return a test of few drawn values of the numbers, and a nightly one of many, which prints the counts."""

    def test(count):
        results = Counter()

        @settings(max_examples=count, database=None)
        @given(st.data())
        def run(data):
            number = numbers()[data.draw(st.integers(0, len(numbers()) - 1))]
            value = data.draw(strategy_of(number))
            results[check(number, value)] += 1

        run()
        print(dict(results))
        assert results["accepted"] > 0
        assert results["refused"] > 0

    return pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.nightly)])(test)


# ------------------------------------------------------------------------------------------------ request


def places(path):
    """Return the keys and indices of a number in a sample request, from the path of the parser."""
    steps = [step for step in re.findall(r"\w+|(?<=\[)\d+(?=\])", path.partition(" (")[0])]
    return [int(step) if step.isdigit() else step for step in steps]


def find(sample, path):
    """Return the table or list with a number of a sample request, and its key or index there; None if it has none."""
    owner, steps = sample, places(path)
    for step in steps[:-1]:
        if not isinstance(owner, (dict, list)) or (isinstance(owner, dict) and step not in owner):
            return None
        owner = owner[step]
    last = steps[-1]
    if isinstance(owner, list) and isinstance(last, str):
        # The numbers of a position in a list have the paths of a table.
        last = ("ra", "dec", "radius").index(last)
    return (owner, last) if isinstance(owner, list) or last in owner else None


@cache
def request_numbers():
    """Return (sample request, key) for each number of a request."""
    found = []
    for sample in request_keys.SAMPLES:
        for key in request_keys.read_keys(sample):
            is_listed = key.is_number and key.lo != -math.inf
            if is_listed and find(sample, key.path) and key.name not in [other.name for _, other in found]:
                found.append(smaller(sample, key))
    return found


def smaller(sample, key):
    """Return a sample with only those sections that a number needs, which is parsed faster, and the key of the number.

    Of a list of pointings or observations, only the item with the number is kept.
    """
    section, index, *_ = *places(key.path), 0
    kept = {name: sample[name] for name in ("name", "seed", "area", section)}
    if section == "stars":
        kept["universe"] = {"star_limit": 24.0}
    if section in ("pointing", "observation"):
        kept[section] = [sample[section][index]]
        key = replace(key, path=key.path.replace(f"{section}[{index}]", f"{section}[0]", 1))
    return kept, key


def value_of_key(number):
    _, key = number
    if key.legal:
        return values(min(key.legal), max(key.legal), is_whole=True)
    return values(key.lo, key.hi, is_whole=key.kind == "whole number")


def check_key(number, value):
    sample, key = number
    changed = copy.deepcopy(sample)
    owner, last = find(changed, key.path)
    owner[last] = value
    is_whole = key.kind != "whole number" or isinstance(value, int)
    inside = is_whole and (value in key.legal if key.legal else is_inside(value, key.lo, key.hi))
    name = key.path.partition(" (")[0]
    return judge(lambda: from_toml.from_table(changed), value, name, inside)


test_numbers_of_a_request = examples(request_numbers, value_of_key, check_key)


def test_all_numbers_of_the_records_of_a_request_are_listed():
    """A new key with a number must be added to the samples of scripts/request_keys.py."""
    names = set(request_keys.all_keys())
    sections = {
        "accuracy": Accuracy, "universe": Universe, "stars": Stars, "structure.arms": Arms,
        "structure.stamps": Stamps, "pointing": Pointing, "observation": Observation, "sources": UserSources,
        "": Request,
    }  # fmt: skip
    # Numbers of a record that have another key, or that the command line sets.
    others = {"strong_lens_boost": "strong_lenses.boost", "limit": "seed", "density": "seed", "magnitude": "seed",
              "universe.lensing": "universe.lensing.g1",
              "observation.macc": "observation.macc (groups)"}  # fmt: skip
    for section, record in sections.items():
        for field in fields(record):
            if re.search(r"\b(int|float)\b", str(field.type)):
                path = f"{section}.{field.name}".lstrip(".")
                assert others.get(path, path) in names


# ------------------------------------------------------------------------------------------------ mission


@cache
def mission_numbers():
    """Return (parameter, unit, lowest and highest value) for each parameter, in the unit of its tightest range."""
    found = []
    for parameter in MISSION.parameters:
        ranges = bounds.bounds_of_parameter(parameter.key)
        unit = min(ranges, key=lambda limits: convert(limits[1], limits[2], ranges[0][2], ""))[2]
        scaled = [tuple(convert(limit, other, unit, "") for limit in (lo, hi)) for lo, hi, other in ranges]
        found.append((parameter.key, unit, max(lo for lo, _ in scaled), min(hi for _, hi in scaled)))
    return found


def value_of_parameter(number):
    key, _, lo, hi = number
    is_count = bounds.is_count(key)
    return values(int(lo) if is_count else lo, int(hi) if is_count else hi, is_whole=is_count)


def check_parameter(number, value):
    key, unit, lo, hi = number
    inside = is_inside(value, lo, hi) and not (bounds.is_count(key) and value % 1)
    is_converted = unit != MISSION.parameter(key).unit
    # The conversion to the unit of the database may round a value next to a limit to the limit.
    near = abs(value) < 1e300 and any(math.isclose(value, limit, rel_tol=1e-14, abs_tol=1e-300) for limit in (lo, hi))
    assume(inside or not (is_converted and near))

    def read():
        override = checks.parse_override({"value": value, "unit": unit}, key, True, units_of_parameters())
        MISSION.with_overrides({key: (override.value, override.unit)})

    return judge(read, value, key, inside)


@cache
def units_of_parameters():
    return instruments.parameter_units(())


test_parameters_of_the_mission = examples(mission_numbers, value_of_parameter, check_parameter)


def test_all_parameters_have_limits():
    for parameter in MISSION.parameters:
        ranges = bounds.bounds_of_parameter(parameter.key)
        assert ranges
        assert all(np.isfinite([lo, hi]).all() for lo, hi, _ in ranges)


def test_limits_may_be_given_in_other_units():
    MISSION.with_overrides({"nisp.filter.thickness": (100.0, "mm")})


@pytest.mark.parametrize(
    ("effect", "key"),
    [
        (straylight.EFFECT, "halo.radius"), (trap_pumping.EFFECT, "cti.dwell_time"),
        (nonlinearity.EFFECT, "nonlinearity.low"), (nonlinearity.EFFECT, "nonlinearity.high"),
        (nonlinearity.EFFECT, "nonlinearity.low_scale"), (straylight.EFFECT, "halo.fraction"),
        (trap_pumping.EFFECT, "pumping.shuffles"), (trap_pumping.EFFECT, "pumping.phase_time"),
    ],
)  # fmt: skip
def test_effects_can_be_computed_at_the_limits_of_their_parameters(effect, key):
    for name, unit, *limits in mission_numbers():
        for value in limits if name == f"vis.{key}" else ():
            mission = MISSION.with_overrides({name: (value, unit)})
            scene = Scene(mission, "vis", 560.0, 0.25, 1e4, detectors.detector("vis", "3-4", mission))
            with np.errstate(divide="raise", invalid="raise", over="raise"):
                effect.parameters(scene)
                assert np.isfinite(effect.margin(scene))


# ------------------------------------------------------------------------------------------------ tables


@cache
def row_of(table):
    """Return a row within the limits of a table, by column."""
    row = {}
    for column in table.columns:
        plain = {"string": "x", "bool": True}.get(
            column.type, max(column.lo or 0, 0) if (column.hi or 0) >= 0 else column.hi
        )
        plain = column.codes[0][0] if column.codes else plain
        row[column.name] = [[]] if column.type.startswith("list") else [plain]
    return row


def value_of_column(number):
    _, column = number
    is_whole = column.type.startswith("int")
    lo, hi = (int(limit) if is_whole and limit is not None else limit for limit in (column.lo, column.hi))
    return values(lo, hi, is_whole)


def check_column(number, value):
    table, column = number
    kind = np.dtype(column.type).type
    limits = [None if limit is None else kind(limit) for limit in (column.lo, column.hi)]
    if isinstance(value, int) and not column.type.startswith("int"):
        value = float(min(max(value, -(2**900)), 2**900))
    codes = [code for code, _ in column.codes]
    inside = is_inside(value, column.lo, column.hi)
    if column.type.startswith("float"):
        with np.errstate(over="ignore"):
            stored = round_mantissa(np.array([value], kind), column.mantissa_bits or 64)[0]
        inside = is_inside(stored, *limits)
    else:
        inside = inside and value == round(value) and np.iinfo(kind).min <= value <= np.iinfo(kind).max

    def read():
        with np.errstate(over="ignore"):
            array = np.array([value], kind) if column.type.startswith("float") else [value]
        rows = table.build({**row_of(table), column.name: array})
        messages = [line for line in find_violations(rows, table) if f"column {column.name} " in line]
        if messages:
            raise BadInput(messages[0])

    if codes and inside and value not in codes:
        inside = False
    return judge(read, value, column.name, inside)


test_columns_of_a_lake = examples(lambda: COLUMNS, value_of_column, check_column)


# ------------------------------------------------------------------------------------------------ files of users


@cache
def file_numbers():
    """Return (kind of file, column, limits) for tables that need no other files."""
    kinds = {
        "pointings": pointing_tables.BOUNDS, "galaxies": given_sources.GIVEN_GALAXY_BOUNDS,
        "stars": given_sources.GIVEN_STAR_BOUNDS,
    }  # fmt: skip
    # Columns of spectra, which added sources do not have, are ignored.
    ignored = ("z_true", "sed", "ext_law", "ebv", "teff")
    listed = [(kind, name, *limits) for kind, columns in kinds.items() for name, limits in columns.items()]
    return [number for number in listed if number[0] == "pointings" or number[1] not in ignored]


def value_of_file(number):
    _, _, lo, hi = number
    return values(float(lo), float(hi), is_whole=False)


def check_file(number, value):
    kind, name, lo, hi = number
    if kind == "pointings":
        file = Path(tempfile.gettempdir()) / f"pointings-{os.getpid()}.csv"
        row = {"ra": "1", "dec": "2", "band": "lsst_r", name: quote_value(value)}
        file.write_text(f"{','.join(row)}\n{','.join(row.values())}\n")
        result = judge(lambda: pointing_tables.read(file, ("EXT",), "science"), value, name, is_inside(value, lo, hi))
        file.unlink()
        return result
    columns = {"ra": [1.0], "dec": [2.0], "mag": [20.0], name: [value]}
    if kind == "galaxies":
        columns["ebv"] = [0.0]
    if name in ("e1", "e2"):
        columns = {"e1": [0.0], "e2": [0.0], **columns}
    settings = {"ellipticity": "distortion", "axes": "east_north"} if name in ("e1", "e2") else {}
    # Values that are stored in single precision may exceed a limit by its rounding error.
    slack = 1e-6 * max(abs(lo), abs(hi)) if name not in ("ra", "dec", "mag", "stamp", "teff") else 0.0
    inside = is_inside(value, lo - slack, hi + slack)
    return judge(lambda: injected_rows.read_rows({kind: columns}, **settings), value, name, inside)


test_columns_of_files = examples(file_numbers, value_of_file, check_file)
