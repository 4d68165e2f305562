"""How large a room, a file and a function may be, and where a channel may be named."""

import ast
import graphlib
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jobs.accuracy import SURVEY
from jobs.render.channels import costs, ground, registry
from jobs.render.effects.effect import Effect
from lake_schema.errors import BadInput
from lake_schema.tables.exposures import CHANNELS

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted(path for package in ("lake_schema", "jobs") for path in (ROOT / package).rglob("*.py"))
MODULES, LINES, FUNCTION, PARAMETERS = 16, 400, 60, 8


def functions(tree):
    """(name, parameters, lines, whether it is compiled) of every function; self and cls are no parameters."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            given = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
            compiled = any("jit" in ast.unparse(decorator) for decorator in node.decorator_list)
            lines = node.end_lineno - node.lineno + 1
            yield node.name, len([name for name in given if name not in ("self", "cls")]), lines, compiled


def test_no_room_is_crowded():
    rooms = {path.parent for path in SOURCES}
    crowded = {room.as_posix(): n for room in rooms if (n := len([*room.glob("[!_]*.py")])) > MODULES}
    assert crowded == {}


def test_no_file_is_long():
    long = {path.as_posix(): n for path in SOURCES if (n := len(path.read_text().splitlines())) > LINES}
    assert long == {}


def test_no_function_is_large():
    larger = {}
    for path in SOURCES:
        for name, parameters, lines, compiled in functions(ast.parse(path.read_text())):
            where = f"{path.relative_to(ROOT).as_posix()}:{name}"
            if not compiled and (parameters > PARAMETERS or lines > FUNCTION):
                larger[where] = parameters, lines
    assert larger == {}


def test_functions_are_measured():
    text = "@jit\ndef a(x): pass\ndef b(self, x, *, y=1):\n    return x\n"
    assert sorted(functions(ast.parse(text))) == [("a", 1, 1, True), ("b", 2, 2, False)]


def test_channels_are_named_where_they_are_made():
    """Whatever differs from channel to channel is asked of the channel, not of its name."""
    name = re.compile("|".join(f"[\"']{code}[\"']" for code, _ in CHANNELS))
    own = [ROOT / "jobs" / "render" / room for room in ("channels", "planning", "camera")]
    found = [
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "jobs" / "render").rglob("*.py")
        if not any(path.is_relative_to(room) for room in own) and name.search(path.read_text())
    ]
    assert found == []


def test_quadrants_are_known_where_they_are_read():
    """What is assembled from a readout is asked of the channel's readout mode."""
    render = ROOT / "jobs" / "render"
    quadrants = render / "effects" / "readout" / "quadrants.py"
    knowing = {path.relative_to(render).parts[0] for path in render.rglob("*.py") if quadrants in imported(path)}
    assert knowing == {"channels"}


def brighter(frame, factor, rng=None):
    return frame * factor


def test_a_channel_is_added_in_one_place(monkeypatch):
    """One of one effect and one camera: an entry in the registry and a row of costs; all else asks the channel."""
    from tests.jobs.render import fields
    from tests.jobs.render.exposure.test_render import field

    effect = Effect("brighter", brighter, lambda scene: (3.0,), lambda scene: 1.0, optional=False, cost=1e-3)
    made = replace(ground.CHANNEL, effects={"science": (effect,)})
    monkeypatch.setattr(registry, "CHANNELS", {**registry.CHANNELS, "DUMMY": made})
    measured = costs.of_channel("EXT")
    monkeypatch.setattr(costs, "of_channel", lambda name: measured)
    _, exposed, body, points = field("EXT")
    exposed = {**exposed, "channel": "DUMMY"}
    tables = body, fields.fluxes(body, "lsst_r", 3.0), points, fields.fluxes(points, "lsst_r", 3.0)
    one = fields.rendered(exposed, fields.small("lsstcam", "R22_S11", 256), tables, fields.MISSION, SURVEY)
    assert one.noise_free.max() > 100.0
    assert [decision.name for decision in one.decisions] == ["brighter"]
    np.testing.assert_allclose(one.science, 3.0 * one.noise_free, rtol=1e-5, atol=1.0)
    assert [extension.name for extension in one.readout.extensions] == [""]


@pytest.mark.parametrize("name", [name for name in dict(CHANNELS) if name not in registry.CHANNELS])
def test_a_channel_that_nothing_renders_has_no_effects(name):
    assert registry.effects_or_none(name, "science") is None


def test_an_effect_without_a_cost_is_refused():
    effect = Effect("brighter", brighter, lambda scene: (3.0,), lambda scene: 1.0)
    with pytest.raises(BadInput, match="effect brighter has the cost 0: a forecast would take it as free"):
        replace(ground.CHANNEL, effects={"science": (effect,)})


def test_array_types_are_named_once():
    """All modules take their names from lake_schema/arrays.py."""
    named = re.findall(r"^(\w+) = (npt\.NDArray\[.+\])$", (ROOT / "lake_schema" / "arrays.py").read_text(), re.M)
    assert ("Float", "npt.NDArray[np.float64]") in named
    spelt = {path.as_posix() for path in SOURCES for _, form in named if form in path.read_text()}
    assert spelt == {(ROOT / "lake_schema" / "arrays.py").as_posix()}


def imported(path):
    """Modules of the project that a file imports, at its top or within functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in ("jobs", "lake_schema"):
            for name in node.names:
                inner = ROOT / (f"{node.module}.{name.name}".replace(".", "/") + ".py")
                outer = ROOT / (node.module.replace(".", "/") + ".py")
                yield from (file for file in (inner, outer) if file.exists())


def test_no_modules_import_each_other_in_a_circle():
    """Not even within functions: what is imported late to avoid a circle is one."""
    graph = graphlib.TopologicalSorter({path: set(imported(path)) for path in SOURCES if path.name != "__init__.py"})
    graph.prepare()
