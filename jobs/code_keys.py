"""Keys of code: what is cached is made anew when any code that may have shaped it changes.

code_key   of a module and of all that it imports, for jobs.cache.content_key
modules    which these are
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

from jobs.cache import content_key

_ROOT = Path(__file__).resolve().parents[1]
# What checks, stores, transports or names arrays and shapes none: its changes leave them as they are.
_SHAPES_NONE = (
    "jobs.cache", "jobs.code_keys", "jobs.request", "lake_schema.arrays", "lake_schema.columns", "lake_schema.errors",
    "lake_schema.mission", "lake_schema.store", "lake_schema.tables",
)  # fmt: skip


@lru_cache
def code_key(module: str) -> str:
    """sha256 (hex) of the code of a module, `__name__`, and of every module of ours that it imports, however far.

    A function that moves from one of them to another changes the key, and so does one that comes from a new module.
    Numbers that the code reads from tables are not in it: they go into the key of what is made of them.
    """
    return content_key(*(part for name in modules(module) for part in (name, _source(name))))


def modules(module: str) -> tuple[str, ...]:
    """Names of a module and of those of ours that it imports, directly or not, sorted; ImportError where it is none."""
    found, left = set[str](), [module]
    while left:
        name = left.pop()
        if name not in found:
            found.add(name)
            left.extend(_imported(name))
    return tuple(sorted(found))


def _file(module: str) -> Path | None:
    path = _ROOT / module.replace(".", "/")
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None)


def _source(module: str) -> bytes:
    file = _file(module)
    if file is None:
        raise ImportError(f"no module {module} in {_ROOT}")
    return file.read_bytes()


@lru_cache
def _imported(module: str) -> tuple[str, ...]:
    """Modules of ours that one imports itself, wherever in its file."""
    return tuple(_imports(ast.parse(_source(module))))


def _imports(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            # What is imported from a package may be a module, else is in the package's own file.
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (_ours(name) or _ours(node.module) for name in names if _ours(name) or _ours(node.module))
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if _ours(alias.name))


def _ours(module: str) -> str:
    """The module, if it is one of ours that may shape an array."""
    if module.split(".")[0] not in ("jobs", "lake_schema") or _file(module) is None:
        return ""
    return "" if any(f"{module}.".startswith(f"{name}.") for name in _SHAPES_NONE) else module
