"""Limit the size of packages, files and functions, and the files that contain names of channels."""

import ast
import graphlib
import re
import sys
import types
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lake_schema.errors import BadInput
from lake_schema.mission import model, parameter
from lake_schema.mission.configuration import resolve
from lake_schema.tables.exposures import CHANNELS
from truesky.render.camera import detectors
from truesky.render.channels import ground, registry
from truesky.render.effects.effect import Effect
from truesky.render.planning import planned_exposures, survey, tasks
from truesky.render.planning.source_counts import Densities
from truesky.render.products import fits_files, read_back
from truesky.request.accuracy import SURVEY
from truesky.request.from_toml import from_table
from truesky.request.schema import Universe

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted(path for package in ("lake_schema", "truesky") for path in (ROOT / package).rglob("*.py"))
MODULES_BY_NAME = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in SOURCES}
MODULES, LINES, FUNCTION, PARAMETERS = 16, 400, 60, 8


def functions(tree):
    """Return (name, parameters, lines, True if compiled) of every function, without self and cls."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            given = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
            compiled = any("jit" in ast.unparse(decorator) for decorator in node.decorator_list)
            lines = node.end_lineno - node.lineno + 1 - docstring_lines(node)
            yield node.name, len([name for name in given if name not in ("self", "cls")]), lines, compiled


def docstring_lines(node):
    """Return the number of lines of the docstring of a module, class or function."""
    if ast.get_docstring(node) is None:
        return 0
    return node.body[0].end_lineno - node.body[0].lineno + 1


def lines_of_code(text):
    """Return the number of lines of a file outside docstrings."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    docstrings = (docstring_lines(node) for node in ast.walk(ast.parse(text)) if isinstance(node, documented))
    return len(text.splitlines()) - sum(docstrings)


def test_number_of_modules_per_package_is_limited():
    modules = Counter(path.parent.as_posix() for path in SOURCES if path.name != "__init__.py")
    assert {room: n for room, n in modules.items() if n > MODULES} == {}


def test_length_of_files_is_limited():
    texts = {path.as_posix(): text for path in SOURCES if (text := path.read_text()).count("\n") > LINES}
    assert {path: n for path, text in texts.items() if (n := lines_of_code(text)) > LINES} == {}


def test_size_of_functions_is_limited():
    larger = {}
    for path in SOURCES:
        for name, parameters, lines, compiled in functions(ast.parse(path.read_text())):
            where = f"{path.relative_to(ROOT).as_posix()}:{name}"
            if not compiled and (parameters > PARAMETERS or lines > FUNCTION):
                larger[where] = parameters, lines
    assert larger == {}


def test_size_of_functions_is_measured():
    text = "@jit\ndef a(x): pass\ndef b(self, x, *, y=1):\n    return x\n"
    assert sorted(functions(ast.parse(text))) == [("a", 1, 1, True), ("b", 2, 2, False)]


def test_channel_names_are_only_in_allowed_files():
    """Code uses attributes of a channel instead of its name."""
    name = re.compile("|".join(f"[\"']{code}[\"']" for code, _ in CHANNELS))
    own = [ROOT / "truesky" / "render" / room for room in ("channels", "planning", "camera")]
    found = [
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "truesky" / "render").rglob("*.py")
        if not any(path.is_relative_to(room) for room in own) and name.search(path.read_text())
    ]
    assert found == []


def texts(tree):
    """Return the strings of a file without docstrings, including the constant parts of f-strings."""
    docs = {
        id(first.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        for first in node.body[:1]
        if isinstance(first, ast.Expr)
    }
    constants = (node for node in ast.walk(tree) if isinstance(node, ast.Constant) and id(node) not in docs)
    return [node.value for node in constants if isinstance(node.value, str)]


CAMERA = re.compile(r"(vis|nisp|ext)(\.|$)")


def test_camera_names_are_only_in_allowed_files():
    """Code finds the parameters of a camera by the section of the detector."""
    own = [ROOT / "truesky" / "render" / room for room in ("channels", "planning", "camera")]
    named = {
        path.relative_to(ROOT).as_posix(): found
        for path in (ROOT / "truesky" / "render").rglob("*.py")
        if not any(path.is_relative_to(room) for room in own)
        and (found := [text for text in texts(ast.parse(path.read_text())) if CAMERA.match(text)])
    }
    assert named == {}


def test_camera_names_are_detected():
    tree = ast.parse(
        '"""vis"""\ndef f(a):\n    """nisp"""\n    return a in ("vis", "nisp", "ext_law"), f"ext.{a}", "vis.x"'
    )
    assert sorted(text for text in texts(tree) if CAMERA.match(text)) == ["ext.", "nisp", "vis", "vis.x"]


def test_only_readout_modes_use_quadrants():
    """Other code uses the readout mode of a channel to assemble images."""
    render = ROOT / "truesky" / "render"
    quadrants = render / "effects" / "readout" / "quadrants.py"
    knowing = {path.relative_to(render).parts[0] for path in render.rglob("*.py") if quadrants in imported(path)}
    assert knowing == {"channels"}


# A channel with one effect, and its camera, declared in lake_schema: LSSTCam under another name.
DUMMY = '''"""A channel that makes everything three times as bright."""

from truesky.render.camera import bands
from truesky.render.channels import readout
from truesky.render.channels.channel import Channel
from truesky.render.channels.cost import Cost
from truesky.render.effects.effect import Effect
from truesky.render.psf import seeing
from truesky.render.sky import diffuse_light

def apply(frame, factor, rng):
    return frame * factor


EFFECT = Effect("brighter", apply, lambda scene: (3.0,), lambda scene: 1.0, optional=False, cost=1.0)
CHANNEL = Channel(
    effects={"science": (EFFECT,)},
    psf=lambda exposure, detector, band, mission, positions: seeing.moffat_psf(0.7, 3.0, detector.pixel_scale),
    readout=readout.FRAME,
    bands=bands.ground_bands,
    sky=diffuse_light.ground_sky,
    cost=Cost(1.0, 0.5, 1e-3, 1e-3, 0.5, 33.0, 34.0, 2.0),
    on_ground=True,
)
'''
TOUCHED = {"channels/dummy.py": DUMMY, "channels/registry.py": None}


def with_the_dummy(monkeypatch):
    """Add or change the files of TOUCHED in the renderer, and return the module of the dummy channel."""
    text = (ROOT / "truesky" / "render" / "channels" / "registry.py").read_text()
    for old, new in (
        (
            "def _vis()",
            "def _dummy():\n    from truesky.render.channels import dummy\n\n    return dummy.CHANNEL\n\n\ndef _vis()",
        ),
        ('_Channels({"VIS"', '_Channels({"DUMMY": _dummy, "VIS"'),
    ):
        assert text.count(old) == 1
        text = text.replace(old, new)
    made = {name: types.ModuleType(f"truesky.render.channels.{name}") for name in ("dummy", "registry")}
    for path, source in {**TOUCHED, "channels/registry.py": text}.items():
        module = made[Path(path).stem]
        exec(compile(source, path, "exec"), module.__dict__)
        if module.__name__ not in sys.modules:
            monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(registry, "CHANNELS", made["registry"].CHANNELS)
    return made["dummy"]


def with_its_camera(monkeypatch):
    """Add a camera to the mission database."""

    def copied(records):
        own = [r for r in records if r.key.startswith("ext.lsstcam.")]
        return [*records, *(replace(r, key=r.key.replace("ext.lsstcam.", "ext.dummycam.")) for r in own)]

    for module in [m for name, m in sys.modules.items() if name.startswith(("truesky.", "lake_schema."))]:
        if hasattr(module, "CAMERAS"):
            monkeypatch.setattr(module, "CAMERAS", (*parameter.CAMERAS, "dummycam"))
    return resolve(copied(parameter.read_all_parameters()), models=copied(model.read_models()))


def test_a_new_channel_changes_two_files_of_the_renderer(monkeypatch, tmp_path):
    """A channel with one effect and one camera is planned, forecast, rendered, written and read."""
    from tests.truesky.render import fields
    from tests.truesky.render.exposure.test_render import field

    assert len(TOUCHED) == 2
    mission = with_its_camera(monkeypatch)
    dummy = with_the_dummy(monkeypatch)
    _, old, body, points = field("EXT")
    asked = {name: old[name] for name in ("camera", "band", "ra", "dec", "position_angle", "mjd", "exposure_time_s")}
    area = {"cone": {"ra": 53.1, "dec": -27.8, "radius": 1.0}}
    pointing = {"channel": "EXT", **asked, "detectors": ["R22_S11"]}
    request = from_table({"name": "x", "seed": 1, "area": area, "pointing": [pointing]})
    (pointing,) = request.pointings
    request = replace(request, pointings=(replace(pointing, channel="DUMMY", camera="dummycam"),))
    ((wanted, _),) = survey.exposures(request, mission)
    exposures = planned_exposures.table([wanted], [mission])
    (row,) = exposures.to_pylist()
    # The parameter is for a dark zenith, and the Moon is up here.
    assert 1.0 < row["sky"] / mission.value("ext.dummycam.lsst_r.sky") < 5.0
    table = tasks.table(exposures, [wanted.detectors], mission, Densities(mission, Universe()))
    (task,) = table.to_pylist()
    # 4072 x 4000 pixels of an effect that takes a second a million, besides what the channel costs.
    assert task["seconds"] > 16.0 + dummy.CHANNEL.cost.frame_s
    assert task["sources"] > 0
    tables = body, fields.fluxes(body, "lsst_r", 3.0), points, fields.fluxes(points, "lsst_r", 3.0)
    detector = replace(detectors.detector("dummycam", "R22_S11", mission), nx=256, ny=256, injection_rows=0)
    one = fields.rendered(row, detector, tables, mission, SURVEY)
    assert one.noise_free.max() > 100.0
    assert [decision.name for decision in one.decisions] == ["brighter"]
    np.testing.assert_allclose(one.science, 3.0 * one.noise_free, rtol=1e-5, atol=1.0)
    made, writers = fits_files.products(one, ())
    path = tmp_path / "science.fits"
    writers[made["path"][0].as_py()](path)
    np.testing.assert_array_equal(read_back.frame(path).data, one.science)


def test_a_channel_without_renderer_has_no_effects():
    others = [name for name in (*dict(CHANNELS), "RADIO") if name not in registry.CHANNELS]
    assert "RADIO" in others
    assert [registry.find_effects_or_none(name, "science") for name in others] == [None] * len(others)


def test_an_effect_without_a_cost_is_refused():
    effect = Effect("brighter", lambda frame, rng: frame, lambda scene: (), lambda scene: 1.0)
    with pytest.raises(BadInput, match="effect brighter has the cost 0, but it must be positive"):
        replace(ground.CHANNEL, effects={"science": (effect,)})


def test_array_types_are_defined_once():
    """All modules import array types from lake_schema/arrays.py."""
    named = re.findall(r"^(\w+) = (npt\.NDArray\[.+\])$", (ROOT / "lake_schema" / "arrays.py").read_text(), re.M)
    assert ("Float", "npt.NDArray[np.float64]") in named
    spelt = {path.as_posix() for path in SOURCES for _, form in named if form in path.read_text()}
    assert spelt == {(ROOT / "lake_schema" / "arrays.py").as_posix()}


def imported(path):
    """Return the modules of the project that a file imports, including imports in functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in ("lake_schema", "truesky"):
            for name in node.names:
                both = f"{node.module}.{name.name}", node.module
                yield from (MODULES_BY_NAME[module] for module in both if module in MODULES_BY_NAME)


def test_there_are_no_circular_imports():
    """Imports in functions count as well."""
    graph = graphlib.TopologicalSorter({path: set(imported(path)) for path in SOURCES if path.name != "__init__.py"})
    graph.prepare()
