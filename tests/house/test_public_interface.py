"""Notebooks, the README and the page about Python import `truesky` alone, and use its public names."""

import ast
import json
import re
from pathlib import Path

import pytest

import truesky

ROOT = Path(__file__).resolve().parents[2]
# Folders of the tree that Python can import.
OURS = {"benchmarks", "jobs", "lake_schema", "notebooks", "requests", "scripts", "tests", "truesky"}
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
FILES = [*sorted((ROOT / "notebooks").glob("*.ipynb")), ROOT / "README.md", ROOT / "docs" / "python.md"]


def sources(path):
    """Code of each cell of a notebook, or of each block of a page."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        return BLOCK.findall(text)
    cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    return ["".join(cell["source"]) for cell in cells]


def faults(code):
    """Imports of our modules other than `import truesky`, and attributes of it that are not public."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom) and (node.level or (node.module or "").split(".")[0] in OURS):
            yield f"from {node.module} import {node.names[0].name}"
        if isinstance(node, ast.Import):
            yield from (n.name for n in node.names if n.name.split(".")[0] in OURS and n.name != "truesky")
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "truesky":
            name = node.attr
            if name not in truesky.__all__:
                yield f"truesky.{name}"
        if isinstance(node, ast.Attribute) and node.attr.startswith("_") and not node.attr.endswith("__"):
            yield node.attr


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_only_the_public_interface_is_used(path):
    found = [fault for code in sources(path) for fault in faults(code)]
    assert any("truesky" in code for code in sources(path))
    assert found == []


@pytest.mark.parametrize(
    "code",
    [
        "from truesky.render import models",
        "import truesky.api",
        "import lake_schema.store as store",
        "from benchmarks import _peers",
        "from . import truesky",
        "import truesky\ntruesky.api.lake",
        "lake._explorer",
    ],
)
def test_a_fault_is_recognised(code):
    assert len(list(faults(code))) == 1


def test_notebooks_import_truesky_before_numpy():
    """It limits numpy to the common instruction set; modules that are loaded before it keep theirs."""
    for path in FILES:
        names = [
            name
            for code in sources(path)
            for node in ast.walk(ast.parse(code))
            if isinstance(node, ast.Import | ast.ImportFrom)
            for name in ([node.module] if isinstance(node, ast.ImportFrom) else [n.name for n in node.names])
        ]
        first = [name for name in names if name == "truesky" or name.split(".")[0] in ("numpy", "scipy", "matplotlib")]
        assert first[:1] == ["truesky"], path.name
