"""healpy is imported in parts, and is complete for code that uses the rest of it."""

import subprocess
import sys

import pytest

CODE = """
import sys
from lake_schema.lazy_healpy import healpy as lazy
assert lazy.ang2pix(8, 10.0, 20.0, nest=True, lonlat=True) == 310
assert len(lazy.query_disc(8, [1.0, 0.0, 0.0], 0.2)) > 1
lazy.ang2pix
print(*({"matplotlib", "astropy.coordinates"} & set(sys.modules)), ".")
import healpy
from healpy import alm2map, pixelfunc
assert healpy is lazy
assert healpy.query_disc is lazy.query_disc and healpy.ang2pix is pixelfunc.ang2pix
assert healpy.rotator.Rotator is healpy.Rotator
assert callable(healpy.mollview) and healpy.__version__
try:
    healpy.nothing
except AttributeError as error:
    print(error)
"""


def run(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.splitlines()


def test_functions_of_pixels_need_no_other_library():
    assert run(CODE) == [".", "module 'healpy' has no attribute 'nothing'"]


@pytest.mark.nightly
def test_a_package_that_was_imported_before_is_used():
    code = "import healpy; from lake_schema import lazy_healpy; print(lazy_healpy.healpy is healpy)"
    assert run(code) == ["True"]
