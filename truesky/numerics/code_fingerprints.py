"""Compute fingerprints of code, so that keys of caches change if code or tables change that may affect the contents.

Docstrings, comments and blank lines do not change a fingerprint.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

from truesky.numerics.cache import content_key
from truesky.numerics.code_text import code_text

_ROOT = Path(__file__).resolve().parents[2]
_ENDINGS = (".csv", ".toml")
# Modules that check, store, transport or name arrays but do not compute them.
_IRRELEVANT = (
    "truesky.numerics.cache", "truesky.numerics.code_fingerprints", "truesky.request", "lake_schema.arrays",
    "lake_schema.columns", "lake_schema.errors", "lake_schema.mission", "lake_schema.store", "lake_schema.tables",
)  # fmt: skip

# Modules in these packages whose numbers do affect arrays.
_RELEVANT = ("truesky.request.accuracy",)


@lru_cache
def code_key(module: str) -> str:
    """Return the sha256 (hex) of the code of a module and of all our modules that it imports, directly or not.

    A function that moves from one module to another changes the key, and so does a new module. The key also covers the
    tables of numbers (.csv, .toml) that the modules read. It does not cover the arguments of functions, such as the
    parameters of the mission and the files of the user: the caller adds them to the key of its result.
    """
    code = (part for name in required_modules(module) for part in (name, _code(_source(name))))
    data = (part for file in data_files(module) for part in (file.name, _content(file)))
    return content_key(*code, *data)


def data_files(module: str) -> tuple[Path, ...]:
    """Return the tables of numbers that a module and the modules that it imports name, sorted by path.

    Code names a file by its whole name as a constant, or by the suffix alone if the file has the name of the module.
    """
    return tuple(sorted({file for name in required_modules(module) for file in _scan(name)[1]}))


def required_modules(module: str) -> tuple[str, ...]:
    """Return the names of a module and of all our modules that it imports, directly or not, sorted.

    Raises
    ------
    ImportError
        If there is no such module.
    """
    names, pending = set[str](), [module]
    while pending:
        name = pending.pop()
        if name not in names:
            names.add(name)
            pending.extend(_scan(name)[0])
    return tuple(sorted(names))


def _file(module: str) -> Path | None:
    path = _ROOT / module.replace(".", "/")
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None)


def _source(module: str) -> bytes:
    file = _file(module)
    if file is None:
        raise ImportError(f"no module {module} in {_ROOT}")
    return file.read_bytes()


def _content(file: Path) -> bytes:
    return file.read_bytes()


@lru_cache
def _data() -> dict[str, Path]:
    """Return the path of every table in `truesky` by file name."""
    return {file.name: file for file in (_ROOT / "truesky").rglob("*") if file.suffix in _ENDINGS}


@lru_cache
def _code(source: bytes) -> str:
    return code_text(source.decode())


@lru_cache
def _scan(module: str) -> tuple[tuple[str, ...], tuple[Path, ...]]:
    """Return the modules that a module imports itself, anywhere in its file, and the tables that it names."""
    tree = ast.parse(_source(module))
    texts = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
    names = {module.rpartition(".")[2] + text if text in _ENDINGS else text for text in texts}
    files = tuple(_data()[name] for name in names if isinstance(name, str) and name in _data())
    return tuple(_imports(tree)), files


def _imports(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            # A name that is imported from a package is a module, or is defined in the package's __init__.py.
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (
                _relevant_module(name) or _relevant_module(node.module)
                for name in names
                if _relevant_module(name) or _relevant_module(node.module)
            )
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if _relevant_module(alias.name))


def _relevant_module(module: str) -> str:
    """Return the module if it is one of ours that may shape an array, else ""."""
    if module.split(".")[0] not in ("lake_schema", "truesky") or _file(module) is None:
        return ""
    if module in _RELEVANT:
        return module
    return "" if any(f"{module}.".startswith(f"{name}.") for name in _IRRELEVANT) else module
