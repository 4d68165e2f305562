"""Avoid the import of pandas in processes that do not use it, because it takes a third of a second.

Arrow imports pandas, if it is installed, when it converts its first object or array, to recognise objects of pandas.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType


class _Unavailable:
    """Finder and loader (see `sys.meta_path`) that lets the import of pandas fail, and leaves other modules alone."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        # Do not raise the error here, because libraries search for optional packages without importing them.
        return ModuleSpec(fullname, self) if fullname == "pandas" else None  # type: ignore[arg-type]

    def create_module(self, spec: ModuleSpec) -> None:
        raise ModuleNotFoundError("pandas is hidden, because its import takes too long", name=spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """Do nothing; importlib requires this method of a loader."""


def hide_pandas() -> None:
    """Make every import of pandas in this process fail, as if it was not installed; do nothing if it is imported.

    Call this only in a program that never uses pandas, and before `pyarrow.dataset` is imported.
    """
    if "pandas" not in sys.modules:
        sys.meta_path.insert(0, _Unavailable())
