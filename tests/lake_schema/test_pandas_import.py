"""pandas can be hidden, and libraries that support it then work without it."""

import subprocess
import sys

import pytest

CODE = """
import sys
{}
from lake_schema.pandas_import import hide_pandas
hide_pandas()
import pyarrow.dataset
from astropy.table import Table
assert pyarrow.array(["a", None]).null_count == 1 and len(Table({{"x": [1, 2]}})) == 2
try:
    import pandas
    print("imported")
except ModuleNotFoundError as error:
    print(error.name, "is missing")
"""


def run(before):
    return subprocess.run(
        [sys.executable, "-c", CODE.format(before)], capture_output=True, text=True, check=True
    ).stdout


def test_arrow_and_astropy_work_without_pandas():
    assert run("") == "pandas is missing\n"


@pytest.mark.nightly
def test_an_imported_pandas_stays():
    assert run("import pandas") == "imported\n"
