"""Compile functions with numba, and keep their machine code in the project's cache.

A function is compiled once per machine and version of the sources, not once per process or per copy of the package.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from lake_schema import instruction_set
from truesky.numerics import cache

# numba reads these variables when it is imported. Child processes inherit them.
instruction_set.limit_numba()
_MACHINE_CODE = cache.machine_code_dir()
os.environ["NUMBA_CACHE_DIR"] = str(_MACHINE_CODE)

import numba  # noqa: E402
from numba.core.caching import UserProvidedCacheLocator  # noqa: E402

Function = TypeVar("Function", bound=Callable[..., Any])
_PACKAGE = Path(__file__).parents[1]
_CONFIG: Any = numba.config
# The other locators are for functions of users, and for machines on which the cache cannot be written. The options
# below affect the machine code, so that this file must be part of its key, too: it names truesky.numerics.compiling.
_LOCATORS = f"{__name__}.PackageCacheLocator,UserProvidedCacheLocator,InTreeCacheLocator,UserWideCacheLocator"


class PackageCacheLocator(UserProvidedCacheLocator):
    """Name the machine code of a module by the module's place in the package.

    By default numba names it by the absolute path of the file, so that each clone and each environment would compile
    again. The cache folder is named by the contents of all compiled modules, so that the files of one folder belong to
    the same sources.
    """

    def __init__(self, py_func: Callable[..., Any], py_file: str) -> None:
        base: Any = super()
        base.__init__(py_func, py_file)
        self._cache_path = str(_MACHINE_CODE / ".".join(Path(py_file).relative_to(_PACKAGE).parent.parts))

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> Any:
        """Return a locator; None for a function outside the package, or if the cache cannot be written."""
        if not Path(py_file).is_relative_to(_PACKAGE):
            return None
        locator: Any = cls(py_func, py_file)
        try:
            locator.ensure_cache_path()
        except OSError:
            return None
        return locator

    def get_source_stamp(self) -> str:
        """Return a constant: the name of the cache folder already depends on the sources."""
        return ""


def _compile(function: Function, **options: Any) -> Function:
    previous = _CONFIG.CACHE_LOCATOR_CLASSES
    _CONFIG.CACHE_LOCATOR_CLASSES = _LOCATORS
    try:
        decorate: Any = numba.njit(cache=True, error_model="numpy", **options)
        compiled: Function = decorate(function)
    finally:
        _CONFIG.CACHE_LOCATOR_CLASSES = previous
    return compiled


def jit(function: Function) -> Function:
    """Compile a function for speed when it is first called: sums may be computed in any order."""
    # Sums in any order are twice as fast; NaN and infinity remain valid. The order depends on the function into which
    # a function is inlined. Always inline it: otherwise a process that compiles would round differently from a process
    # that finds the caller in the cache.
    fast = {"reassoc", "contract", "nsz"}
    return _compile(function, fastmath=fast, forceinline=True)


def exact_jit(function: Function) -> Function:
    """Compile a function so that every operation is rounded as written: the same bits on any processor.

    The function releases the GIL, so that other threads run at the same time.
    """
    return _compile(function, nogil=True)
