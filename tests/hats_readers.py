"""Libraries that read HATS. They take seconds to load, in each process of tests, so a test loads them when it runs."""

from functools import cache

import pytest

# Names the folder of compiled code.
import truesky.numerics.machine_code  # noqa: F401


def is_valid(folder):
    """Return whether a catalogue is valid by the strict rules of `hats`."""
    from hats.io.validation import is_valid_catalog

    return is_valid_catalog(str(folder), strict=True)


def open_catalog(folder, **options):
    """Open a catalogue by `lsdb`."""
    lsdb = pytest.importorskip("lsdb", reason="lsdb is not installed (extra test)")
    _keep_compiled_code()
    return lsdb.open_catalog(folder, **options)


@cache
def _keep_compiled_code():
    """Keep the compiled code of `hats` in the cache: it compiles for 5 s in each process that matches catalogues."""
    from hats.pixel_tree import moc_filter, pixel_alignment
    from numba.core.dispatcher import Dispatcher

    for module in (moc_filter, pixel_alignment):
        for compiled in vars(module).values():
            if isinstance(compiled, Dispatcher):
                compiled.enable_caching()
