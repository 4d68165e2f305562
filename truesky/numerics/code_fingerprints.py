"""Keys of code: what is cached is made anew when any code that may have shaped it changes, or any table of numbers.

code_key     of a module and of all that it imports, for truesky.numerics.cache.content_key
modules      which these are
data_files   the tables of numbers that they read
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

from truesky.numerics.cache import content_key

_ROOT = Path(__file__).resolve().parents[2]
_ENDINGS = (".csv", ".toml")
# What checks, stores, transports or names arrays and shapes none: its changes leave them as they are.
_IRRELEVANT = (
    "truesky.numerics.cache", "truesky.numerics.code_fingerprints", "truesky.request", "lake_schema.arrays",
    "lake_schema.columns", "lake_schema.errors", "lake_schema.mission", "lake_schema.store", "lake_schema.tables",
)  # fmt: skip

# Numbers in one of these packages that do shape arrays.
_RELEVANT = ("truesky.request.accuracy",)


@lru_cache
def code_key(module: str) -> str:
    """sha256 (hex) of the code of a module, `__name__`, and of every module of ours that it imports, however far.

    A function that moves from one of them to another changes the key, and so does one that comes from a new module.
    The tables of numbers (.csv, .toml) that they read are in it; what they are given, such as the mission's parameters
    and the user's files, goes into the key of what is made of it.
    """
    code = (part for name in required_modules(module) for part in (name, _source(name)))
    data = (part for file in data_files(module) for part in (file.name, _content(file)))
    return content_key(*code, *data)


def data_files(module: str) -> tuple[Path, ...]:
    """Tables of numbers that the code of a module and of what it imports names, wherever in `truesky` they lie; sorted.

    A file is named by its whole name as a constant, or by the ending alone where it has the module's own name.
    """
    return tuple(sorted({file for name in required_modules(module) for file in _named_files(name)}))


def required_modules(module: str) -> tuple[str, ...]:
    """Names of a module and of those of ours that it imports, directly or not, sorted; ImportError where it is none."""
    names, pending = set[str](), [module]
    while pending:
        name = pending.pop()
        if name not in names:
            names.add(name)
            pending.extend(_direct_imports(name))
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
    """Every table of `truesky` by its name."""
    return {file.name: file for file in (_ROOT / "truesky").rglob("*") if file.suffix in _ENDINGS}


@lru_cache
def _named_files(module: str) -> tuple[Path, ...]:
    texts = {node.value for node in ast.walk(ast.parse(_source(module))) if isinstance(node, ast.Constant)}
    names = {module.rpartition(".")[2] + text if text in _ENDINGS else text for text in texts}
    return tuple(_data()[name] for name in names if isinstance(name, str) and name in _data())


@lru_cache
def _direct_imports(module: str) -> tuple[str, ...]:
    """Modules of ours that one imports itself, wherever in its file."""
    return tuple(_imports(ast.parse(_source(module))))


def _imports(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            # What is imported from a package may be a module, else is in the package's own file.
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (
                _relevant_module(name) or _relevant_module(node.module)
                for name in names
                if _relevant_module(name) or _relevant_module(node.module)
            )
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if _relevant_module(alias.name))


def _relevant_module(module: str) -> str:
    """The module, if it is one of ours that may shape an array."""
    if module.split(".")[0] not in ("lake_schema", "truesky") or _file(module) is None:
        return ""
    if module in _RELEVANT:
        return module
    return "" if any(f"{module}.".startswith(f"{name}.") for name in _IRRELEVANT) else module
