"""What goes into the fingerprint of the code."""

import re
import tomllib
from pathlib import Path

from lake_schema.provenance import libraries

PROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"
# They carry rows, look at them or draw them, and make none.
HARMLESS = {"duckdb", "matplotlib", "pandas", "pyspark", "tqdm"}


def test_every_library_that_shapes_a_byte_is_in_the_fingerprint():
    wanted = tomllib.loads(PROJECT.read_text())["project"]["dependencies"]
    names = {re.match(r"[\w.-]+", entry)[0] for entry in wanted}
    assert set(libraries()) == names - HARMLESS | {"python"}
    assert names > HARMLESS
