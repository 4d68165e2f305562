"""Everything about a lake (a folder of versioned tables) that does not simulate: declarations, storage and reading.

The package also contains sky geometry, and the mission database with the numbers of telescopes, cameras and survey.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from lake_schema import instruction_set

# Limit the processor instructions of numpy and other libraries first: the limit has no effect after numpy is imported.
instruction_set.limit()

if TYPE_CHECKING:
    from lake_schema.store import layout, read

__version__ = "0.1.0"
__all__ = ["layout", "read"]


def __getattr__(name: str) -> Any:
    """Import `lake_schema.store.layout` or `.read` when it is first used; raise AttributeError for other names."""
    if name in __all__:
        return import_module(f"lake_schema.store.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
