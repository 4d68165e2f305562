"""Simulate the Euclid sky, from dark-matter haloes to raw detector images.

A request is a TOML file (or a dictionary) that defines a simulation, and a lake is the folder with its tables and
images. `check` validates a request and returns a `Request`. `run` computes catalogues, fluxes, a plan of exposures and
images, and stores them in a lake. `open` opens a lake for reading and returns a `Lake`, whose method `image` returns an
`Image`. `accuracies` lists the errors and costs of the named settings of accuracy. The module `plots` draws the results
of `Lake.hist`, `Lake.heatmap` and `Lake.skymap`. `frame` opens a calibrated frame of a real telescope, to which sources
can be added. All errors derive from `LakeError`: `BadInput` for invalid input,
`Damaged` for files whose content has changed.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from lake_schema import __version__
from lake_schema.errors import BadInput, Damaged, LakeError

if TYPE_CHECKING:
    from lake_schema.fits.images import Image
    from truesky.api.given_frames import frame
    from truesky.api.lake import Lake
    from truesky.api.lake import Lake as open
    from truesky.api.simulate import accuracies, check, run
    from truesky.explore import plots
    from truesky.request.schema import Request

__all__ = [
    "BadInput", "Damaged", "Image", "Lake", "LakeError", "Request", "__version__", "accuracies", "check", "frame",
    "open", "plots", "run",
]  # fmt: skip

# Names of the package that are imported on first use, because all imports together take seconds: the module, and the
# attribute in it (None for the module).
_LAZY_IMPORTS: dict[str, tuple[str, str | None]] = {
    "Image": ("lake_schema.fits.images", "Image"),
    "Lake": ("truesky.api.lake", "Lake"),
    "Request": ("truesky.request.schema", "Request"),
    "accuracies": ("truesky.api.simulate", "accuracies"),
    "check": ("truesky.api.simulate", "check"),
    "frame": ("truesky.api.given_frames", "frame"),
    "open": ("truesky.api.lake", "Lake"),
    "plots": ("truesky.explore.plots", None),
    "run": ("truesky.api.simulate", "run"),
}


def __getattr__(name: str) -> Any:
    if name in _LAZY_IMPORTS:
        module, attribute = _LAZY_IMPORTS[name]
        loaded = import_module(module)
        return loaded if attribute is None else getattr(loaded, attribute)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
