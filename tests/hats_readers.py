"""Libraries that read HATS. They take seconds to load, in each process of tests, so a test loads them when it runs."""

import pytest


def is_valid(folder):
    """Return whether a catalogue is valid by the strict rules of `hats`."""
    from hats.io.validation import is_valid_catalog

    return is_valid_catalog(str(folder), strict=True)


def open_catalog(folder):
    """Open a catalogue by `lsdb`."""
    lsdb = pytest.importorskip("lsdb", reason="lsdb is not installed (extra test)")
    return lsdb.open_catalog(str(folder))
