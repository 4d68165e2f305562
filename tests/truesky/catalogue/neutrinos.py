"""A universe with massive neutrinos, with a table that CAMB has computed once in place of CAMB."""

import csv
import zlib
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from truesky.catalogue.matter import boltzmann
from truesky.cosmology import FIDUCIAL
from truesky.numerics import cache

MASSIVE = replace(FIDUCIAL, m_nu=0.06)
# Written by scripts/neutrino_power_table.py for MASSIVE.
_FILE = Path(__file__).with_name("neutrino_power.csv")
# Results of other tables have other versions, so that the cache of a user remains correct.
VERSION = f"test-{zlib.crc32(_FILE.read_bytes())}"


def power():
    """Return P(k) of cold matter for MASSIVE at the wave numbers of a table of CAMB, (Mpc/h)^3."""
    return np.array([float(row["power"]) for row in csv.DictReader(_FILE.read_text().splitlines())])


@contextmanager
def installed(version=VERSION, own_cache=True):
    """Use the table in place of CAMB, which has the given version, and an empty cache if `own_cache` is True."""
    with pytest.MonkeyPatch.context() as patch, cache.use_temporary_dir() if own_cache else nullcontext():
        table = power()
        patch.setattr(boltzmann, "compute", lambda cosmology: {"power": table})
        set_version(patch, version)
        yield


def set_version(patch, version):
    """Set the version of the package CAMB, or None if it is not installed."""

    def version_of(package):
        assert package == "camb"
        if version is None:
            raise metadata.PackageNotFoundError(package)
        return version

    known = SimpleNamespace(version=version_of, PackageNotFoundError=metadata.PackageNotFoundError)
    patch.setattr(boltzmann, "metadata", known)
