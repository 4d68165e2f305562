"""Contents of the fingerprint of the code."""

import re
import tomllib
from pathlib import Path

from lake_schema.store import publish, read, stage
from lake_schema.store.provenance import libraries, machine
from tests.universe import plain_plan, plain_work

PROJECT = Path(__file__).resolve().parents[3] / "pyproject.toml"
# These packages transport, query or plot rows and do not change their bytes.
HARMLESS = {
    "rich",
    "shtab",
    "PyYAML",
    "duckdb",
    "fsspec",
    "h5py",
    "loky",
    "matplotlib",
    "pandas",
    "pyspark",
    "tqdm",
    "universal-pathlib",
}


def test_every_library_that_shapes_a_byte_is_in_the_fingerprint():
    wanted = tomllib.loads(PROJECT.read_text())["project"]["dependencies"]
    names = {re.match(r"[\w.-]+", entry)[0] for entry in wanted}
    assert set(libraries()) == names - HARMLESS | {"python"}
    assert names > HARMLESS


def test_a_version_says_on_which_machines_it_was_made(lake, monkeypatch):
    def elsewhere(function, parts):
        for number, part in enumerate(parts):
            monkeypatch.setattr(stage, "machine", lambda number=number: f"kind {number % 2}")
            yield function(part)

    publish.make_version(lake, plain_plan(1), plain_work)
    assert read.version(lake, "plain").manifest["machines"] == [machine()]
    publish.make_version(lake, plain_plan(2), plain_work, elsewhere)
    assert read.version(lake, "plain").manifest["machines"] == ["kind 0", "kind 1"]
