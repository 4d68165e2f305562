"""What is declared: tables, columns, units, the sky, the mission database, and how the lake keeps them."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from lake_schema import instruction_set

# Before anything imports numpy.
instruction_set.limit()

if TYPE_CHECKING:
    from lake_schema.store import layout, read

__version__ = "0.1.0"
__all__ = ["layout", "read"]


def __getattr__(name: str) -> Any:
    """`from lake_schema import layout, read`, wherever they lie; loaded when they are asked for."""
    if name in __all__:
        return import_module(f"lake_schema.store.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
