"""The package healpy, whose parts that draw maps and transform coordinates are imported when they are first used.

Importing all of healpy takes 1.4 s of CPU time, because it imports matplotlib and astropy.coordinates. The functions of
pixels need neither, and most processes use only them.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec, module_from_spec
from types import ModuleType
from typing import Any

# Modules of healpy with functions of pixels: conversion to positions, interpolation, pixels in a disc or polygon.
_PIXEL_MODULES = ("healpy.pixelfunc", "healpy._query_disc")


class _LazyPackage(ModuleType):
    """The package healpy before its file __init__.py is executed."""

    def __getattr__(self, name: str) -> Any:
        """Return a module of the package or a function of pixels; for another name, import all of healpy first."""
        if not name.startswith("__"):
            if find_spec(f"healpy.{name}") is not None:
                return import_module(f"healpy.{name}")
            for module in _PIXEL_MODULES:
                if find_spec(module) is not None and hasattr(contents := import_module(module), name):
                    # Store the function, so that this method is not called for it again.
                    self.__dict__[name] = getattr(contents, name)
                    return self.__dict__[name]
        # Become a plain module, so that this method is not called again.
        self.__class__ = ModuleType  # type: ignore[assignment]
        spec = self.__spec__
        assert spec is not None
        assert spec.loader is not None
        spec.loader.exec_module(self)
        return getattr(self, name)


def _find_package() -> Any:
    """Return the package healpy: the imported one, or else one that is imported in parts."""
    if "healpy" in sys.modules:
        return sys.modules["healpy"]
    spec = find_spec("healpy")
    if spec is None:
        raise ModuleNotFoundError("No module named 'healpy'", name="healpy")
    package = module_from_spec(spec)
    package.__class__ = _LazyPackage
    # The modules of a package can only be imported if the package is in this dictionary. Code of users that imports
    # healpy afterwards gets the same module, with all its functions.
    sys.modules["healpy"] = package
    return package


healpy = _find_package()
