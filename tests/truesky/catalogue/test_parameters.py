"""Tables of numbers: read by name, refused without their source."""

import tomllib
from pathlib import Path

import pytest

from lake_schema.errors import BadInput
from truesky import catalogue
from truesky.catalogue import parameters

FILES = sorted(Path(catalogue.__file__).parent.glob("*.toml"))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_every_table_of_numbers_states_its_source(file):
    for name in tomllib.loads(file.read_text()):
        section = parameters.section(file.name, name)
        assert section
        assert "source" not in section


def test_a_table_that_is_not_there_is_named():
    with pytest.raises(BadInput, match=r"morphology.toml has no table \[halo\]"):
        parameters.section("morphology.toml", "halo")


def test_a_table_without_source_is_refused(tmp_path, monkeypatch):
    (tmp_path / "bare.toml").write_text("[size]\nlargest = 1.0\n")
    monkeypatch.setattr(parameters, "_FOLDER", tmp_path)
    with pytest.raises(BadInput, match=r"bare.toml: table \[size\] must have a key source"):
        parameters.section("bare.toml", "size")
