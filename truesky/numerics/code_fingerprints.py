"""Compute hashes of code, which are part of the keys under which computed arrays are cached.

The hash of a module changes if its code, the code of modules that it imports, or their tables of numbers change. It
does not change with docstrings, comments and blank lines.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path

from truesky.numerics.cache import content_key
from truesky.numerics.code_text import code_text

_ROOT = Path(__file__).resolve().parents[2]
_ENDINGS = (".csv", ".npz", ".toml")
# Packages and modules that check, store, transport or name arrays but do not compute them. Their code is not part of a
# hash.
_IRRELEVANT = (
    "truesky.numerics.cache", "truesky.numerics.cache_entries", "truesky.numerics.cache_labels",
    "truesky.numerics.code_fingerprints", "truesky.request", "lake_schema.arrays", "lake_schema.columns",
    "lake_schema.errors", "lake_schema.mission", "lake_schema.store", "lake_schema.tables",
)  # fmt: skip

# Modules in the packages of `_IRRELEVANT` that do affect the numbers in arrays.
_RELEVANT = ("truesky.request.accuracy", "lake_schema.mission.ghost_offsets")


@lru_cache
def code_key(module: str) -> str:
    """Return the sha256 (hexadecimal) of the code of a module and of the project modules that affect its arrays.

    These are the modules that it imports directly or indirectly, except modules that only check, store or name arrays,
    such as `lake_schema.tables` and `lake_schema.mission`: a change in them does not change the hash, nor does a
    change in a module that only they import. Comments, docstrings and blank lines do not count. Tables of numbers
    (.csv, .toml) of the package `truesky` are included if the code contains their file name. A function that moves from
    one module to another changes the hash.

    Arguments of functions, such as parameters of the mission and files of the user, are not included: callers must add
    them to the key of a result. Raises ImportError if there is no such module.
    """
    code = (part for name in required_modules(module) for part in (name, _code(_source(name))))
    data = (part for file in data_files(module) for part in (file.name, _content(file)))
    return content_key(*code, *data)


def data_files(module: str) -> tuple[Path, ...]:
    """Return the tables of numbers (.csv, .toml) that a module and the project modules it imports read, sorted by path.

    A table counts as read if a string in the code is its file name, such as "lines.csv". The suffix ".csv" alone stands
    for the file with the name of the module.
    """
    return tuple(sorted({file for name in required_modules(module) for file in _scan(name)[1]}))


def required_modules(module: str) -> tuple[str, ...]:
    """Return the sorted names of a module and of all project modules that it imports, directly or indirectly.

    Modules that cannot affect computed arrays are left out, unless one is the given module.

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
    """Return the path of every table (.csv, .npz, .toml) in the package `truesky` by its file name."""
    return {file.name: file for file in (_ROOT / "truesky").rglob("*") if file.suffix in _ENDINGS}


def _code(source: bytes) -> str:
    return _analyse(source)[2]


@lru_cache
def _scan(module: str) -> tuple[tuple[str, ...], tuple[Path, ...]]:
    """Return the project modules that a module imports directly, also inside functions, and the tables that it names.

    A table is a .csv or .toml file whose name is a string in the code.
    """
    imports, texts, _ = _analyse(_source(module))
    names = {module.rpartition(".")[2] + text if text in _ENDINGS else text for text in texts}
    return imports, tuple(_data()[name] for name in names if name in _data())


@lru_cache(maxsize=1024)
def _analyse(source: bytes) -> tuple[tuple[str, ...], frozenset[str], str]:
    """Return the project modules that a source imports, the strings in it, and its code without comments.

    They are found together, because parsing a source takes most of the time.
    """
    tree = ast.parse(source)
    nodes = list(ast.walk(tree))
    texts = frozenset(node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str))
    return tuple(_imports(nodes)), texts, code_text(source.decode(), tree)


def _imports(nodes: Iterable[ast.AST]) -> Iterator[str]:
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.module:
            # `from package import name` imports the module `name`, or an object of the package's __init__.py.
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (
                _relevant_module(name) or _relevant_module(node.module)
                for name in names
                if _relevant_module(name) or _relevant_module(node.module)
            )
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if _relevant_module(alias.name))


def _relevant_module(module: str) -> str:
    """Return the name of a module if it belongs to this project and may affect computed arrays, else ""."""
    if module.split(".")[0] not in ("lake_schema", "truesky") or _file(module) is None:
        return ""
    if module in _RELEVANT:
        return module
    return "" if any(f"{module}.".startswith(f"{name}.") for name in _IRRELEVANT) else module
