"""A mock sky, from dark-matter haloes to raw detector images.

open   read the tables and images of a lake
run    compute everything that a request asks for
check  report what is wrong with a request
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from lake_schema import __version__
from lake_schema.errors import BadInput, LakeError

if TYPE_CHECKING:
    from truesky.api.lake import Lake
    from truesky.api.lake import Lake as open
    from truesky.api.simulate import check, run

__all__ = ["BadInput", "Lake", "LakeError", "__version__", "check", "open", "run"]

# Loaded when they are first used: together they take seconds to import.
_LAZY = {"Lake": "lake", "open": "lake", "check": "simulate", "run": "simulate"}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(import_module(f"truesky.api.{_LAZY[name]}"), "Lake" if name == "open" else name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
