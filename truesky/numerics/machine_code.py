"""Compile functions with numba, and keep their machine code in the project's cache on disc.

A function is compiled once per machine and version of the source files. Numba by itself would compile it again for each
copy of the package. The decorators are in truesky.numerics.compiling, which imports this module, and so numba, when a
compiled function is first called.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lake_schema import instruction_set
from truesky.numerics import cache, cache_entries

# Set the environment variables of numba before it is imported, because it reads them only once. Child processes inherit
# the variables.
instruction_set.limit_numba()
_MACHINE_CODE = cache.machine_code_dir()
os.environ["NUMBA_CACHE_DIR"] = str(_MACHINE_CODE)
cache_entries.record_use(cache.cache_dir(), _MACHINE_CODE)

import numba  # noqa: E402
from numba.core.caching import UserProvidedCacheLocator  # noqa: E402

_PACKAGE = Path(__file__).parents[1]
_CONFIG: Any = numba.config
# Classes that choose the folder of a function's machine code; numba uses the first that is applicable. Those after
# PackageCacheLocator are for functions of users, and for machines on which the cache cannot be written.
#
# The options of numba below affect the machine code, too, see truesky.numerics.compiling.
_LOCATORS = f"{__name__}.PackageCacheLocator,UserProvidedCacheLocator,InTreeCacheLocator,UserWideCacheLocator"


class PackageCacheLocator(UserProvidedCacheLocator):
    """Choose the folder in which numba keeps the machine code of a module of this package.

    By default numba names the folder by the absolute path of the module's file, so that each copy of the package would
    be compiled again. Here it is named by the module's place in the package. The folder above is named by a hash of all
    compiled modules, so that machine code of different versions is never mixed.
    """

    def __init__(self, py_func: Callable[..., Any], py_file: str) -> None:
        base: Any = super()
        base.__init__(py_func, py_file)
        self._cache_path = str(_MACHINE_CODE / ".".join(Path(py_file).relative_to(_PACKAGE).parent.parts))

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> Any:
        """Return the object that tells numba in which folder the machine code of a function is cached (a locator).

        Return None for a function outside this package, or if the folder cannot be written. Numba then tries its next
        class of locators.
        """
        if not Path(py_file).is_relative_to(_PACKAGE):
            return None
        locator: Any = cls(py_func, py_file)
        try:
            locator.ensure_cache_path()
        except OSError:
            return None
        return locator

    def get_source_stamp(self) -> str:
        """Return a constant, by which numba considers the machine code up to date.

        The name of the folder already depends on the contents of the source files.
        """
        return ""


def compile_function(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """Return the numba function for a Python function; numba compiles it for the types of its arguments when called.

    `options` are further options of numba.njit.
    """
    previous = _CONFIG.CACHE_LOCATOR_CLASSES
    _CONFIG.CACHE_LOCATOR_CLASSES = _LOCATORS
    try:
        decorate: Any = numba.njit(cache=True, error_model="numpy", **options)
        compiled: Callable[..., Any] = decorate(function)
    finally:
        _CONFIG.CACHE_LOCATOR_CLASSES = previous
    return compiled
