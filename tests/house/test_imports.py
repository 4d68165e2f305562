"""Check imports between packages, and forbidden operations."""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted(path for package in ("lake_schema", "truesky") for path in (ROOT / package).rglob("*.py"))
# Formats that run code when they are read.
UNSAFE_MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "marshal", "shelve", "joblib"}
UNSAFE_CALLS = {
    "eval",
    "exec",
    "__import__",
    "os.system",
    "os.popen",
    "yaml.load",
    "yaml.unsafe_load",
    "yaml.full_load",
}
UNSAFE_NAMES = {name.rpartition(".")[2] for name in UNSAFE_CALLS}


@cache
def facts() -> dict[str, tuple[bool, list[str], list[str]]]:
    """Path in the clone -> what is asked of every source.

    The trees are not kept: the garbage collector would visit their million nodes in all later tests.
    """
    found = {}
    for path in SOURCES:
        text = path.read_text()
        tree = ast.parse(text)
        # Each reading of Parquet contains one of these words, and most files contain neither.
        readings = parquet_readings(tree) if "pyarrow" in text or "parquet" in text else []
        found[path.relative_to(ROOT).as_posix()] = touches_fits(tree), readings, unsafe(tree)
    return found


def imported(tree: ast.AST) -> Iterator[str]:
    """Yield the dotted name of every module or object that a file imports, including imports in functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def touches_fits(tree: ast.AST) -> bool:
    """Return True if a file reads or writes FITS with astropy."""
    return any(f"{name}.".startswith("astropy.io.fits.") for name in imported(tree))


def unsafe(tree: ast.AST) -> list[str]:
    """Return the operations of a file that could run untrusted code."""
    found = [name for name in imported(tree) if name.split(".")[0] in UNSAFE_MODULES]
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            last = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if last in UNSAFE_NAMES and (name := ast.unparse(node.func)) in UNSAFE_CALLS:
                found.append(name)
            found += [
                f"{ast.unparse(node.func)}({keyword.arg}=...)"
                for keyword in node.keywords
                if keyword.arg in ("shell", "allow_pickle")
                and not (isinstance(keyword.value, ast.Constant) and keyword.value.value is False)
            ]
    return found


# Modules that read Parquet; what they have that writes, or is of no file.
PARQUET = ("pyarrow.parquet", "pyarrow.dataset", "pyarrow.orc")
NO_READING = {"write_table", "ParquetWriter", "Expression", "field", "scalar"}
# The reader of lakes, and the reader of user files, which runs in a separate process.
# The model of the emulator contains its own checksum, which is compared.
PARQUET_READERS = {"lake_schema/store/parquet.py", "lake_schema/external/files.py", "truesky/emulator/model.py"}


def parquet_readings(tree: ast.AST) -> list[str]:
    """Return the operations of a file that read Parquet: by pyarrow, pandas, polars, DuckDB or Spark."""
    names = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.asname or alias.name: alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    found = [name for name in names.values() if name.startswith(PARQUET) and name not in PARQUET]
    found = [name for name in found if name.rpartition(".")[2] not in NO_READING]
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            module, _, rest = ast.unparse(node.value).partition(".")
            module = ".".join([names.get(module, module), rest]).rstrip(".")
            if module in PARQUET and node.attr not in NO_READING:
                found.append(f"{module}.{node.attr}")
            elif node.attr in ("read_parquet", "scan_parquet", "parquet") and isinstance(node.ctx, ast.Load):
                found.append(ast.unparse(node))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and "read_parquet(" in node.value:
            found.append(node.value)
    return found


def test_every_module_has_a_layer():
    """pyproject.toml lists the allowed imports of every module; each package of truesky has layers."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    within = {one["containers"][0]: one for one in contracts if "containers" in one}
    packages = {f"truesky.{path.parent.name}" for path in (ROOT / "truesky").glob("*/__init__.py")}
    assert within.keys() >= packages | {"truesky", "lake_schema"}
    assert [name for name, one in within.items() if not one.get("exhaustive") or "exhaustive_ignores" in one] == []


def test_only_the_fits_package_uses_astropy_fits():
    assert {path for path, (touches, _, _) in facts().items() if touches} == {
        f"lake_schema/fits/{name}.py"
        for name in ("external", "images", "ldac", "psfex", "row_files", "tables", "write")
    }


def test_only_one_module_reads_parquet():
    """This module compares checksums, so that damaged files are detected."""
    found = {path: set(readings) for path, (_, readings, _) in facts().items() if readings}
    # Rows that a process was handed in a file of Arrow's own, which is removed with it.
    handed = found.pop("truesky/explore/session.py")
    assert handed == {"pyarrow.dataset.dataset", "pyarrow.dataset.Dataset"}
    assert found.keys() == PARQUET_READERS


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("import pyarrow.parquet as pq\npq.read_table('x')", True),
        ("import pyarrow.parquet\npyarrow.parquet.ParquetFile('x')", True),
        ("import pyarrow.parquet as pq\nread = pq.read_schema", True),
        ("from pyarrow import parquet\nparquet.read_table('x')", True),
        ("from pyarrow import dataset as ds\nds.dataset('x')", True),
        ("def f():\n    from pyarrow.parquet import read_table", True),
        ("import pandas as pd\npd.read_parquet('x')", True),
        ("connection.sql('SELECT * FROM read_parquet($files)')", True),
        ("spark.read.parquet('x')", True),
        ("import pyarrow.parquet as pq\npq.write_table(rows, 'x')", False),
        ("from lake_schema.store import parquet\nparquet.read(folder, entry)", False),
    ],
)
def test_reading_parquet_is_detected(text, expected):
    assert bool(parquet_readings(ast.parse(text))) is expected


def test_no_file_runs_untrusted_code():
    assert {path: found for path, (_, _, found) in facts().items() if found} == {}


@pytest.mark.parametrize(
    "text",
    [
        "import pickle",
        "def f():\n    from dill import loads",
        "eval('1')",
        "import os\nos.system('ls')",
        "import yaml\nyaml.load(open('x'))",
        "import numpy as np\nnp.load('x', allow_pickle=True)",
        "import subprocess\nsubprocess.run('ls', shell=True)",
        "import subprocess\nsubprocess.run('ls', shell=flag)",
    ],
)
def test_unsafe_code_is_detected(text):
    assert unsafe(ast.parse(text))


def test_safe_code_is_accepted():
    text = "import numpy as np, subprocess\nnp.load('x', allow_pickle=False)\nsubprocess.run(['ls'])"
    assert unsafe(ast.parse(text)) == []


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("import astropy.io.fits", True),
        ("from astropy.io import fits", True),
        ("def f():\n    from astropy.io.fits import HDUList", True),
        ("from astropy.io.votable import ucd", False),
        ("from lake_schema import fits", False),
    ],
)
def test_use_of_fits_is_detected(text, expected):
    assert touches_fits(ast.parse(text)) is expected
