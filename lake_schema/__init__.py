"""Declarations of the lake's tables, sky geometry and mission database, and the code that stores and reads lakes."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from lake_schema import instruction_set

# The limit has no effect once numpy is imported.
instruction_set.limit()

if TYPE_CHECKING:
    from lake_schema.store import layout, read

__version__ = "0.1.0"
__all__ = ["layout", "read"]


def __getattr__(name: str) -> Any:
    """Import `layout` and `read` from `lake_schema.store` when they are first used."""
    if name in __all__:
        return import_module(f"lake_schema.store.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
