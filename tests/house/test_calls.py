"""Check that functions used in scripts, benchmarks and notebooks exist and accept the given arguments."""

import ast
import importlib
import inspect
import json
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted(
    path for folder in ("scripts", "benchmarks", "notebooks") for path in (ROOT / folder).glob("*.*")
    if path.suffix in (".py", ".ipynb")
)  # fmt: skip


def source(path):
    """Return the code of a file or of all cells of a notebook."""
    text = path.read_text()
    if path.suffix == ".py":
        return text
    cells = (cell["source"] for cell in json.loads(text)["cells"] if cell["cell_type"] == "code")
    return "\n".join("".join(line for line in cell if line[0] not in "%!") for cell in cells)


def imported(tree):
    """Return imported name -> object of the project, without names that the file redefines."""
    names = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in ("lake_schema", "truesky"):
            names |= {alias.asname or alias.name: (node.module, alias.name) for alias in node.names}
    again = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name) and not isinstance(n.ctx, ast.Load)}
    again |= {node.arg for node in ast.walk(tree) if isinstance(node, ast.arg)}
    return names, again


def found(module, name):
    """Return an attribute of a module or a module of a package. Raises AttributeError if it does not exist."""
    try:
        return getattr(importlib.import_module(module), name)
    except AttributeError:
        if importlib.util.find_spec(f"{module}.{name}") is None:
            raise
        return importlib.import_module(f"{module}.{name}")


def faults(tree):
    """Return lines that use missing names, or call functions with invalid arguments."""
    names, again = imported(tree)
    ours = {}
    for name, (module, wanted) in names.items():
        try:
            ours[name] = found(module, wanted)
        except (ImportError, AttributeError) as error:
            yield f"import of {name}: {error}"
    ours = {name: thing for name, thing in ours.items() if name not in again}
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Attribute)
            and isinstance(node.value, ast.Name)
            and inspect.ismodule(module := ours.get(node.value.id))
            and not hasattr(module, node.attr)
        ):
            yield f"{node.lineno}: {ast.unparse(node)} is not there"
        if not isinstance(node, ast.Call) or any(isinstance(given, ast.Starred) for given in node.args):
            continue
        called, function = None, node.func
        if isinstance(function, ast.Name):
            called = ours.get(function.id)
        elif isinstance(function, ast.Attribute) and isinstance(function.value, ast.Name):
            called = getattr(ours.get(function.value.id), function.attr, None)
        # Classes of other libraries may have no signature.
        ours_too = (getattr(called, "__module__", None) or "").split(".")[0] in ("lake_schema", "truesky")
        if ours_too and all(keyword.arg for keyword in node.keywords):
            try:
                inspect.signature(called).bind(*node.args, **{keyword.arg: None for keyword in node.keywords})
            except TypeError as error:
                yield f"{node.lineno}: {ast.unparse(function)}: {error}"


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_called_functions_exist(path):
    assert list(faults(ast.parse(source(path)))) == []


@pytest.mark.parametrize(
    "text",
    [
        "from truesky.randomness import nothing",
        "from truesky.randomness import rng\nrng.nothing",
        "from truesky.randomness import rng\nrng.key_hex(seed=1)",
        "from truesky.randomness.rng import stream\nstream(1, nothing=2, seed=3)",
        "from lake_schema.store import nothing",
    ],
)
def test_a_fault_is_recognised(text):
    assert len(list(faults(ast.parse(text)))) == 1
