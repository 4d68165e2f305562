"""What goes into the fingerprint of the code."""

import os
import platform
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from lake_schema.store import publish, read, stage
from lake_schema.store.provenance import libraries, machine
from tests.universe import plain_plan, plain_work

PROJECT = Path(__file__).resolve().parents[3] / "pyproject.toml"
# They carry rows, look at them or draw them, and make none; what the last three make, calibrated images, their sources
# and stacks, is in no table of a lake.
HARMLESS = {
    "PyYAML", "aiohttp", "duckdb", "h5py", "matplotlib", "pandas", "pyspark", "tqdm", "astroscrappy", "drizzle", "sep",
    "fsspec", "universal-pathlib",
}  # fmt: skip


def test_every_library_that_shapes_a_byte_is_in_the_fingerprint():
    wanted = tomllib.loads(PROJECT.read_text())["project"]["dependencies"]
    names = {re.match(r"[\w.-]+", entry)[0] for entry in wanted}
    assert set(libraries()) == names - HARMLESS | {"python"}
    assert names > HARMLESS


@pytest.mark.skipif(platform.machine() != "x86_64", reason="names instruction sets of x86-64")
def test_what_changes_last_bits_is_in_the_name_of_a_machine():
    ask = [sys.executable, "-c", "from lake_schema.store.provenance import machine; print(machine())"]

    def told(**variables):
        return subprocess.run(ask, env={**os.environ, **variables}, capture_output=True, text=True, check=True).stdout

    assert told().strip() == machine()
    older = told(NPY_DISABLE_CPU_FEATURES="X86_V3 X86_V4", NUMBA_CPU_NAME="nehalem")
    assert "nehalem" in older
    assert "X86_V3" not in older
    assert platform.libc_ver()[1] in older


def test_a_version_says_on_which_machines_it_was_made(lake, monkeypatch):
    def elsewhere(function, parts):
        for number, part in enumerate(parts):
            monkeypatch.setattr(stage, "machine", lambda number=number: f"kind {number % 2}")
            yield function(part)

    publish.make(lake, plain_plan(1), plain_work)
    assert read.version(lake, "plain").manifest["machines"] == [machine()]
    publish.make(lake, plain_plan(2), plain_work, elsewhere)
    assert read.version(lake, "plain").manifest["machines"] == ["kind 0", "kind 1"]
